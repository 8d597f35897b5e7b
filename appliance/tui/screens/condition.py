"""How gateways are: a state in few words, and what is wrong in whole sentences, each with its remedy. Pure.

The same on the screens of the fleet, of one gateway and of the pool, so that none calls well what another calls broken.
"""

from collections.abc import Iterable

from msgspec import Struct
from rich.text import Text

from appliance.record.facts import RecorderStatus
from appliance.record.heard import kinds_text
from appliance.tui.drawing import clock, counted
from appliance.tui.safe import safe
from appliance.tui.store import SILENT, Gateway


class Note(Struct, frozen=True, kw_only=True):
    """Something about a gateway that a person is to know."""

    weight: int
    """0: gone; 1: broken; 2: works less than it could; 3: the machine lacks something; 4: for information."""
    about: str
    """`gateway`, or `pool` for what keeps containers from being started."""
    glyph: str
    style: str
    text: str
    remedy: str = ""

    def line(self, name: str = "") -> Text:
        """Return it as a line, with a gateway's name before it where several are told of."""
        told = f"{safe(name, 63)}: {self.text}" if name else self.text
        return Text(f"{self.glyph} {told}{f' → {self.remedy}' if self.remedy else ''}", self.style)


def gateway_state(gateway: Gateway) -> tuple[str, str]:
    """Return a gateway's state in few words, with its sign and style; `notes_of` has the whole story."""
    status = gateway.status
    if gateway.lost_ns:
        return f"✘ lost {clock(gateway.lost_ns)[:5]}", "red"
    if status.draining:
        return "◌ draining", "magenta"
    if status.pool_problem:
        return "✘ pool", "red"
    if status.overloaded:
        return "▲ overload", "yellow"
    if not status.limits_enforced:
        return "▲ no limits", "yellow"
    return "✔ up", "green"


def notes_of(gateway: Gateway) -> list[Note]:
    """Return what is to be known of a gateway, the worst first."""
    each, name = gateway.status, safe(gateway.status.id, 63)
    if gateway.lost_ns:
        gone = f"not reachable since {clock(gateway.lost_ns)}"
        remedy = "see to its power, network, service"
        return [Note(weight=0, about="gateway", glyph="✘", style="red", text=gone, remedy=remedy)]
    found: list[Note] = []
    if each.pool_problem:
        text, remedy = safe(each.pool_problem), _pool_remedy(each.pool_problem, name)
        found.append(Note(weight=1, about="pool", glyph="✘", style="red", text=text, remedy=remedy))
    if each.overloaded:
        text, remedy = safe(each.overloaded), "its runs are moved away by themselves; `:drain` gives all away"
        found.append(Note(weight=2, about="gateway", glyph="▲", style="yellow", text=text, remedy=remedy))
    if each.draining:
        text, remedy = safe(each.drain) or "gives its runs away", "`:undrain` when it is to take runs again"
        found.append(Note(weight=2, about="gateway", glyph="◌", style="magenta", text=text, remedy=remedy))
    if not each.limits_enforced:
        text = "container limits are not enforced (no cgroups)"
        remedy = "`swiftbot doctor`"
        found.append(Note(weight=3, about="gateway", glyph="▲", style="yellow", text=text, remedy=remedy))
    if each.site_problem:
        text, remedy = safe(each.site_problem), "add [fence] to the site's file: points outside it are then refused"
        found.append(Note(weight=3, about="gateway", glyph="▲", style="yellow", text=text, remedy=remedy))
    if refused := sum(each.refused.values()):
        kinds = ", ".join(f"{safe(kind, 40)} {count}" for kind, count in sorted(each.refused.items()))
        text = f"{refused} bad inputs refused ({kinds})"
        found.append(Note(weight=4, about="gateway", glyph="·", style="dim", text=text))
    return found


def _pool_remedy(problem: str, gateway: str) -> str:
    """Return what helps a pool: an image that is left alone waits for a person's word, memory and Podman do not."""
    if "left alone" in problem:
        return f"mend the image, then `:release IMAGE {gateway}`"
    if "MB for containers" in problem:
        return "end what else takes memory there, or lower `pool.memory_mb`"
    return "`swiftbot doctor` there says why"


def gateway_notes(gateways: Iterable[Gateway], *, about: str = "") -> list[Text]:
    """Return what is to be known of several gateways, a line each, the worst first.

    Args:
        gateways: of which it is told.
        about: only what concerns this (`Note.about`); empty: everything.
    """
    found = [(note, each.status.id) for each in gateways for note in notes_of(each) if about in ("", note.about)]
    return [note.line(name) for note, name in sorted(found, key=lambda each: each[0].weight)]


def recorder_notes(recorders: Iterable[RecorderStatus]) -> list[Text]:
    """Return how the recorders are, a line each."""
    lines: list[Text] = []
    for each in recorders:
        name = f"recorder {safe(each.id, 63)}".removesuffix(" recorder")
        missed = sum(each.missed.values())
        lost = f", missed {missed:,} messages of keys {safe(kinds_text(each.missed), 240)}" if missed else ""
        if each.problem:
            remedy = "`swiftbot record` starts it again" if each.state == "failed" else "make room, or see its log"
            lines.append(Text(f"✘ {name}: {safe(each.problem)}{lost} → {remedy}", "red"))
        elif each.state == SILENT:
            lines.append(Text(f"▲ {name}: not heard any more{lost} → is `swiftbot record` running?", "yellow"))
        else:
            sign, style = ("▲", "yellow") if missed else ("✔", "dim")
            told = f"{sign} {name}: {counted(each.messages, 'message')} in {safe(each.file, 200)}{lost}"
            lines.append(Text(told, style))
    return lines
