"""Places and robots that are out of use for a while, and the requests about them."""

import re
from datetime import datetime
from hashlib import sha256
from typing import Annotated, Literal

from msgspec import Meta, Struct

from appliance.model.steering import Signed, Word

Kind = Literal["place", "robot"]
MOST_PLAIN = 50
"""Characters of a name that stand in a record's id as they are."""


class Closure(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A place that is closed, or a robot in maintenance: a record of the DHT, and a put at each change."""

    kind: Kind
    name: str
    """Of the place on the site, or of the robot."""
    by: Word
    until_ns: int = 0
    """When it ends by itself, Unix nanoseconds; 0: when an operator ends it."""
    ended_ns: int = 0
    """When it was over; only in the last put of it."""

    @property
    def id(self) -> str:
        """Of its record: there is one for a place or robot."""
        return closure_id(self.kind, self.name)

    @property
    def text(self) -> str:
        """Why it is out of use, in words, by the clock of the machine that says it."""
        what = "closed" if self.kind == "place" else "in maintenance"
        until = ""
        if self.until_ns:
            until = f" until {datetime.fromtimestamp(self.until_ns / 1e9).astimezone():%Y-%m-%d %H:%M %Z}"
        return f"{what}{until} by {self.by.by}{f': {self.by.why}' if self.by.why else ''}"

    def holds(self, now_ns: int) -> bool:
        """Whether it is in force."""
        return not self.ended_ns and (not self.until_ns or now_ns < self.until_ns)


def closure_id(kind: Kind, name: str) -> str:
    """Return the id of the closure of a place or robot; names that differ in case or blanks alone share one."""
    folded = " ".join(name.casefold().split())
    plain = re.sub(r"[^a-z0-9_-]+", "-", folded).strip("-")[:MOST_PLAIN]
    if re.fullmatch(rf"[a-z0-9_ -]{{1,{MOST_PLAIN}}}", folded):
        return f"{kind}.{plain}"
    # In what a key may have, names of other letters, such as two in Greek, look alike: one would open the other.
    return f"{kind}.{plain}.{sha256(folded.encode(errors='surrogatepass')).hexdigest()[:12]}"


class CloseAsk(Signed, frozen=True, kw_only=True):
    """`close_place` and `maintain`: take a place or robot out of use, or change until when."""

    kind: Kind
    name: Annotated[str, Meta(min_length=1, max_length=120)]
    until_ns: Annotated[int, Meta(ge=0, le=2**62)] = 0


class ReopenAsk(Signed, frozen=True, kw_only=True):
    """`reopen`: take it into use again; answers with what it was."""

    kind: Kind
    name: Annotated[str, Meta(min_length=1, max_length=120)]


class ClosuresAsk(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`closures`: all that the asked gateway knows of, or those whose records are its own (`local`)."""

    local: bool = False


class ClosureList(Struct, frozen=True, kw_only=True):
    """What is out of use, by kind and name."""

    closures: tuple[Closure, ...] = ()
