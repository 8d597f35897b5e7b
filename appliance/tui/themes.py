"""How the terminal UI looks: themes for dark and light rooms, for eyes that tell red from green badly, and for glare.

Text is styled with the names of a terminal's colours, each of which stands for a part (`status_styles`): a theme says
what they look like. In the colour-blind-safe ones well is blue and broken is vermilion, after Okabe and Ito's palette
(Color Universal Design, 2008); in those of high contrast every text has at least 7:1 against its ground (WCAG 2.2,
1.4.6).
"""

from msgspec import Struct
from rich.terminal_theme import TerminalTheme
from textual.theme import Theme

Rgb = tuple[int, int, int]


class Look(Struct, frozen=True, kw_only=True):
    """A theme of Textual with what the eight colours of a terminal look like in it."""

    name: str
    help: str
    dark: bool
    ground: str
    text: str
    primary: str
    well: str
    works: str
    broken: str
    next: str
    leaving: str
    past: str

    @property
    def panel(self) -> str:
        """The ground of header, footer and fields: near enough to the other for all colours to be read on it."""
        return _between(self.ground, self.text, 0.1)

    @property
    def cursor(self) -> str:
        """The ground of the selected row, which a sign and bold letters tell as well."""
        return _between(self.ground, self.primary, 0.15)

    def dimmed(self, ground: str) -> str:
        """What past and idle things look like on a ground: as Textual mixes them."""
        return _between(ground, self.text, 0.66)

    def theme(self) -> Theme:
        """Return it as Textual has it."""
        return Theme(
            name=self.name,
            primary=self.primary,
            secondary=self.next,
            accent=self.primary,
            warning=self.works,
            error=self.broken,
            success=self.well,
            foreground=self.text,
            background=self.ground,
            surface=self.ground,
            panel=self.panel,
            dark=self.dark,
            text_alpha=1.0,
            variables={"footer-key-foreground": self.primary, "text-muted": self.past, "cursor": self.cursor},
        )

    def terminal(self) -> TerminalTheme:
        """Return what the terminal's colours look like: black, red, green, yellow, blue, magenta, cyan, white."""
        colours = [_rgb(each) for each in (
            self.ground, self.broken, self.well, self.works, self.primary, self.leaving, self.next, self.text,
        )]  # fmt: skip
        return TerminalTheme(_rgb(self.ground), _rgb(self.text), colours, colours)


def _rgb(colour: str) -> Rgb:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _between(one: str, other: str, share: float) -> str:
    mixed = (round(a + (b - a) * share) for a, b in zip(_rgb(one), _rgb(other), strict=True))
    return "#" + "".join(f"{each:02x}" for each in mixed)


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours, 1 to 21 (WCAG 2.2, relative luminance)."""
    bright, dark = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (bright + 0.05) / (dark + 0.05)


def _luminance(colour: str) -> float:
    parts = [each / 255 for each in _rgb(colour)]
    linear = [each / 12.92 if each <= 0.03928 else ((each + 0.055) / 1.055) ** 2.4 for each in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


LOOKS: tuple[Look, ...] = (
    Look(
        name="dark", help="For dark rooms", dark=True, ground="#101418", text="#e6e6e6", primary="#5fb0ff",
        well="#66d17a", works="#f2c14e", broken="#ff7b72", next="#56d4dd", leaving="#d2a8ff", past="#a8b0b8",
    ),
    Look(
        name="light", help="For bright rooms", dark=False, ground="#fafafa", text="#1b1f24", primary="#0550ae",
        well="#116329", works="#7a4d00", broken="#b3001b", next="#0b5c66", leaving="#6f2da8", past="#57606a",
    ),
    Look(
        name="blind-dark", help="Dark, colour-blind-safe: blue is well, vermilion is broken", dark=True,
        ground="#101418", text="#e6e6e6", primary="#9ecbff",
        well="#56b4e9", works="#f0e442", broken="#ff8a3d", next="#b8e0d2", leaving="#e5a3c9", past="#a8b0b8",
    ),
    Look(
        name="blind-light", help="Light, colour-blind-safe: blue is well, vermilion is broken", dark=False,
        ground="#fafafa", text="#1b1f24", primary="#003a70",
        well="#005b96", works="#6b5900", broken="#a83c00", next="#00614a", leaving="#8a3a6c", past="#57606a",
    ),
    Look(
        name="contrast-dark", help="Dark, high contrast", dark=True, ground="#000000", text="#ffffff",
        primary="#9ad1ff", well="#7dff8a", works="#ffe14d", broken="#ff9d94", next="#7df4ff", leaving="#e7c6ff",
        past="#d0d0d0",
    ),
    Look(
        name="contrast-light", help="Light, high contrast", dark=False, ground="#ffffff", text="#000000",
        primary="#003a8c", well="#0b4a1c", works="#5c3a00", broken="#8a0014", next="#06444c", leaving="#4f1d80",
        past="#404040",
    ),
)  # fmt: skip
BY_NAME: dict[str, Look] = {look.name: look for look in LOOKS}
