"""What operators do not allow for a while or for good: places and robots out of use, standing rules; requests."""

import re
from datetime import datetime
from hashlib import sha256
from typing import Annotated, Literal
from zoneinfo import ZoneInfo

from msgspec import Meta, Struct, json

from appliance.model.steering import Signed, Word

Kind = Literal["place", "robot", "rule"]
MOST_PLAIN = 50
"""Characters of a name that stand in a record's id as they are."""


DAY_MIN = 24 * 60
DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
ANYTHING = "anything"
"""In `Rule.things`: whatever it is."""
_Names = Annotated[tuple[Annotated[str, Meta(min_length=1, max_length=120)], ...], Meta(max_length=64)]


class Rule(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What some robots never do, a standing rule: go to places, take things up, or, with neither, start any subtask.

    With hours or days it holds at those times only. A value that is no rule is a ValueError.
    """

    robots: _Names = ()
    """Empty: all of `group`, those that join later too."""
    group: Literal["all", "flying", "ground"] = "all"
    places: _Names = ()
    """By their names on the site; a robot that passes them on its way elsewhere is not kept from it."""
    things: _Names = ()
    """Words of what is taken up; `anything`: whatever it is."""
    begin_min: Annotated[int, Meta(ge=0, lt=DAY_MIN)] = 0
    end_min: Annotated[int, Meta(gt=0, le=DAY_MIN)] = DAY_MIN
    """Minutes since midnight by the clock of `zone`; an end before the begin is on the next day."""
    days: Annotated[tuple[Annotated[int, Meta(ge=0, le=6)], ...], Meta(max_length=7)] = ()
    """On which its hours begin, 0 for Monday; empty: every day."""
    zone: Annotated[str, Meta(max_length=80)] = "UTC"
    """IANA name."""

    def __post_init__(self) -> None:
        """Check what the bounds of single fields cannot tell."""
        if self.begin_min == self.end_min:
            raise ValueError("the hours of a rule begin when they end")
        if self.places and self.things:
            raise ValueError("a rule is about places or about things that are taken up, not about both")
        if not all(any(map(str.isalnum, each)) for each in self.things):
            raise ValueError("a rule names a thing by words")
        if not (self.places or self.things or self.timed):
            raise ValueError("a rule names places, things, hours or days")

    @property
    def timed(self) -> bool:
        """Whether it holds at some times only."""
        return bool(self.days) or (self.begin_min, self.end_min) != (0, DAY_MIN)

    @property
    def id(self) -> str:
        """The same for the same rule, whoever adds it."""
        return f"r-{sha256(json.encode(self)).hexdigest()[:8]}"

    @property
    def text(self) -> str:
        """It in words."""
        who = ", ".join(self.robots) or f"{self.group} robots"
        what = "start any subtask"
        if self.places:
            what = f"go to {' or '.join(self.places)}"
        elif self.things:
            what = f"take up {' or '.join(self.things)}"
        hours = ""
        if (self.begin_min, self.end_min) != (0, DAY_MIN):
            hours = f" from {_clock(self.begin_min)} to {_clock(self.end_min)}"
        days = f" on {', '.join(DAYS[each] for each in self.days)}" if self.days else ""
        return f"{who}: never {what}{hours}{days}{f' {self.zone}' if self.timed else ''}"

    def due(self, now_ns: int) -> bool:
        """Whether it holds at a moment by its hours and days. Where its zone is not known it does."""
        if not self.timed:
            return True
        try:
            now = datetime.fromtimestamp(now_ns / 1e9, ZoneInfo(self.zone))
        except (OSError, ValueError, KeyError, OverflowError):
            return True
        minute, day = now.hour * 60 + now.minute, now.weekday()
        if self.begin_min < self.end_min:
            inside = self.begin_min <= minute < self.end_min
        else:
            inside = minute >= self.begin_min or minute < self.end_min
            day = day if minute >= self.begin_min else (day - 1) % 7
        return inside and (not self.days or day in self.days)


def _clock(minute: int) -> str:
    return f"{minute // 60:02}:{minute % 60:02}"


class Closure(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A closed place, a robot in maintenance or a standing rule: a record of the DHT, and a put at each change."""

    kind: Kind
    name: str
    """Of the place on the site, of the robot, or the rule's id."""
    by: Word
    rule: Rule | None = None
    """Of the kind `rule`, which always has it."""
    until_ns: int = 0
    """When it ends by itself, Unix nanoseconds; 0: when an operator ends it."""
    ended_ns: int = 0
    """When it was over; only in the last put of it."""

    def __post_init__(self) -> None:
        """A rule without what it says would hold nothing up, unseen."""
        if (self.kind == "rule") != (self.rule is not None):
            raise ValueError("a closure of the kind rule has a rule, and no other has")

    @property
    def id(self) -> str:
        """Of its record: there is one for a place, robot or rule."""
        return closure_id(self.kind, self.name)

    @property
    def text(self) -> str:
        """Why it is out of use, or what rule it is, in words, by the clock of the machine that says it."""
        what = "closed" if self.kind == "place" else "in maintenance"
        if self.rule is not None:
            what = f"{self.rule.text};"
        until = ""
        if self.until_ns:
            until = f" until {datetime.fromtimestamp(self.until_ns / 1e9).astimezone():%Y-%m-%d %H:%M %Z}"
        return f"{what}{until} by {self.by.by}{f': {self.by.why}' if self.by.why else ''}"

    def holds(self, now_ns: int) -> bool:
        """Whether it is not over."""
        return not self.ended_ns and (not self.until_ns or now_ns < self.until_ns)

    def in_force(self, now_ns: int) -> bool:
        """Whether it holds at a moment: a rule only at its hours."""
        return self.holds(now_ns) and (self.rule is None or self.rule.due(now_ns))


def closure_id(kind: Kind, name: str) -> str:
    """Return the id of the closure of a place, robot or rule; names that differ in case or blanks alone share one."""
    folded = " ".join(name.casefold().split())
    plain = re.sub(r"[^a-z0-9_-]+", "-", folded).strip("-")[:MOST_PLAIN]
    if re.fullmatch(rf"[a-z0-9_ -]{{1,{MOST_PLAIN}}}", folded):
        return f"{kind}.{plain}"
    # In what a key may have, names of other letters, such as two in Greek, look alike: one would open the other.
    return f"{kind}.{plain}.{sha256(folded.encode(errors='surrogatepass')).hexdigest()[:12]}"


class CloseAsk(Signed, frozen=True, kw_only=True):
    """`close`: take a place or robot out of use or add a rule, or change until when."""

    kind: Kind
    name: Annotated[str, Meta(min_length=1, max_length=120)]
    """Of a rule its id, which the gateway makes of what it says."""
    rule: Rule | None = None
    until_ns: Annotated[int, Meta(ge=0, le=2**62)] = 0


class ReopenAsk(Signed, frozen=True, kw_only=True):
    """`reopen`: take it into use again, or remove the rule; answers with what it was."""

    kind: Kind
    name: Annotated[str, Meta(min_length=1, max_length=120)]


class ClosuresAsk(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`closures`: all that the asked gateway knows of, or those whose records are its own (`local`)."""

    local: bool = False


class ClosureList(Struct, frozen=True, kw_only=True):
    """What is out of use, by kind and name, and the standing rules, which older gateways pass over."""

    closures: tuple[Closure, ...] = ()
    rules: tuple[Closure, ...] = ()
