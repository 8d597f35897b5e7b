"""Foreign text made fit for a terminal: names, logs and results come from robots, skills and models.

An escape sequence that reached the terminal would be carried out, a direction override would show a name as another
one, and a line of a megabyte would hold up the screen; any of it may be hostile. So what cannot be printed is shown
as a sign, long text is cut, and Rich's markup is never read: screens put these strings into `Text`, which knows none.
Pure.
"""

import unicodedata

from rich.cells import cell_len

MOST = 500
"""Characters kept when nobody says otherwise: several lines of a wide terminal."""
_STACKED = 2
"""Combining marks kept on one character; more of them paint over the lines above and below."""
_PICTURES = {number: chr(0x2400 + number) for number in range(0x20)} | {0x7F: "␡"}
_SPACES = "\t\n\r\v\f\x1c\x1d\x1e\x1f\x85\u2028\u2029"
_UNSEEN = "�"


def safe(value: object, most: int = MOST, *, blanks: bool = False) -> str:
    """Return foreign text as one line of at most `most` characters that a terminal shows and does not obey.

    Line breaks and tabs become a space, runs of white space one; other control characters become their pictures
    (escape: ␛); characters that set the direction of writing, join, or have no form become one sign each.

    Args:
        value: the text.
        most: characters.
        blanks: leave all blanks where they are, as in a line that has been laid out.
    """
    text = value if isinstance(value, str) else str(value)
    cut = len(text) > most
    if cut:
        text = text[: max(0, most - 1)]
    if not (text.isascii() and text.isprintable()):
        text = "".join(_shown(text))
    if not blanks:
        text = " ".join(text.split())
    return f"{text}…" if cut else text


def _shown(text: str) -> list[str]:
    out: list[str] = []
    stacked = _STACKED  # a mark at the beginning would sit on whatever stands before
    for each in text:
        if " " <= each <= "~":
            stacked = 0
            out.append(each)
            continue
        if each in _SPACES:
            stacked = _STACKED
            out.append(" ")
            continue
        kind = unicodedata.category(each)
        if kind in ("Mn", "Me"):
            stacked += 1
            if stacked <= _STACKED:
                out.append(each)
            continue
        stacked = 0
        if kind == "Cc":
            out.append(_PICTURES.get(ord(each), _UNSEEN))
        elif kind in ("Cf", "Cs", "Cn", "Co"):
            out.append(_UNSEEN)
        else:
            out.append(" " if kind.startswith("Z") else each)
    return out


def safe_lines(value: object, *, most_lines: int = 200, most: int = MOST) -> list[str]:
    """Return foreign text as its lines, each made safe; a last one says how many were left out."""
    text = value if isinstance(value, str) else str(value)
    # A text of many megabytes is cut before it is split: what is beyond could not be shown anyway.
    longest = most_lines * most
    rest = len(text) - longest
    parts = text[:longest].splitlines()
    left_out = len(parts) - most_lines
    found = [safe(part, most) for part in parts[:most_lines]]
    if left_out > 0 or rest > 0:
        more = f"{left_out} more lines" if left_out > 0 else f"{rest:,} more characters"
        found.append(f"… {more}")
    return found


def clip(text: str, cells: int) -> str:
    """Return text cut to so many terminal cells, an ellipsis at the cut; wide characters count two."""
    if cells <= 0:
        return ""
    if cell_len(text) <= cells:
        return text
    out: list[str] = []
    left = cells - 1
    for each in text:
        left -= cell_len(each)
        if left < 0:
            break
        out.append(each)
    return f"{''.join(out)}…"
