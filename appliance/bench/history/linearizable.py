"""Is a history of one register linearizable? The search of Wing and Gong with Lowe's memory of what was tried. Pure.

A history is linearizable when every operation can be given one moment between its call and its return, all moments
different, so that the operations in that order are those of a register that one after the other used. What is asked
here is decided exactly: the answer "no" is a proof, and so is "yes".

The search linearizes, from the earliest on, any operation that nothing else has to precede; at a dead end it takes
the last one back and tries another (Wing & Gong, "Testing and verifying concurrent objects", 1993). A pair of "these
are linearized" and "the register holds that" which was seen before is not tried again (Lowe, "Testing for
linearizability", 2017). Registers are independent, so each key of a history is checked by itself (Horn & Kroening,
"Faster linearizability checking via P-compositionality", 2015).
"""

from collections.abc import Hashable, Sequence
from typing import Literal

from msgspec import Struct

Value = Hashable
Kind = Literal["read", "write", "cas"]


class Op(Struct, frozen=True, kw_only=True):
    """One operation of a client on a register.

    One of unknown outcome (its client died, or heard nothing) has `returned_ns` None: it may have taken effect at
    any time after its call, or never. One that is known to have failed is left out of a history, since it has changed
    nothing, unless it is a `cas` with `ok` False: that one says that the register did not hold `old`.
    """

    process: str
    kind: Kind
    called_ns: int
    returned_ns: int | None
    value: Value = None
    """What was read, or is to be written."""
    old: Value = None
    """`cas`: what must be there before."""
    ok: bool = True
    """`cas`: whether it was done."""


class Verdict(Struct, frozen=True, kw_only=True):
    """The answer; of a history that is not linearizable the longest beginning that was, and what did not fit."""

    linearizable: bool | None
    """None: given up after `most` steps."""
    operations: int
    steps: int = 0
    order: tuple[int, ...] = ()
    """A linearization, as places in the history; of the longest beginning found when there is none of all."""
    stuck: tuple[int, ...] = ()
    """Operations of which none could come next there."""


def step(op: Op, value: Value) -> tuple[bool, Value]:
    """Whether a register that holds `value` can do the operation with that outcome, and what it holds then."""
    match op.kind:
        case "read":
            return op.value == value, value
        case "write":
            return True, op.value
        case "cas":
            if op.old == value:
                return op.ok, op.value
            return not op.ok, value


class _Event:
    """A call or return in time, in a doubly linked list from which what is linearized is taken out."""

    __slots__ = ("match", "next", "number", "previous")

    def __init__(self, number: int, match: "_Event | None") -> None:
        self.number = number
        self.match = match
        """Of a call its return; None marks a return."""
        self.next: _Event | None = None
        self.previous: _Event | None = None

    def lift(self) -> None:
        """Take a call and its return out."""
        for each in (self, self.match):
            if each is not None and each.previous is not None:
                each.previous.next = each.next
                if each.next is not None:
                    each.next.previous = each.previous

    def unlift(self) -> None:
        """Put them back, in the opposite order."""
        for each in (self.match, self):
            if each is not None and each.previous is not None:
                each.previous.next = each
                if each.next is not None:
                    each.next.previous = each


def _timeline(history: Sequence[Op]) -> _Event:
    """Return the head of the list of events in order of time; calls come before returns of the same moment."""
    end = max((max(op.called_ns, op.returned_ns or 0) for op in history), default=0) + 1
    events: list[tuple[int, int, int, _Event]] = []
    for number, op in enumerate(history):
        returned = _Event(number, None)
        call = _Event(number, returned)
        events.append((op.called_ns, 0, number, call))
        events.append((end if op.returned_ns is None else op.returned_ns, 1, number, returned))
    head = last = _Event(-1, None)
    for _, _, _, event in sorted(events, key=lambda each: each[:3]):
        last.next, event.previous = event, last
        last = event
    return head


def check(history: Sequence[Op], *, initial: Value = None, most: int = 5_000_000) -> Verdict:
    """Decide whether a history of one register is linearizable.

    Args:
        history: in any order.
        initial: what the register holds at first.
        most: steps after which it is given up; the problem is NP-complete, real histories are easy.
    """
    head = _timeline(history)
    needed = sum(1 << number for number, op in enumerate(history) if op.returned_ns is not None)
    done, value = 0, initial
    taken: list[tuple[_Event, Value]] = []
    seen: set[tuple[int, Value]] = set()
    best: tuple[int, ...] = ()
    stuck: tuple[int, ...] = ()
    event, steps = head.next, 0
    while needed & ~done:
        steps += 1
        if steps > most:
            return Verdict(linearizable=None, operations=len(history), steps=steps, order=best, stuck=stuck)
        if event is not None and event.match is not None:
            fits, after = step(history[event.number], value)
            state = (done | 1 << event.number, after)
            if fits and state not in seen:
                seen.add(state)
                taken.append((event, value))
                done, value = state
                event.lift()
                event = head.next
            else:
                event = event.next
            continue
        # A return: whatever comes next must have been called before it, and nothing of that fits.
        if len(taken) > len(best) or not stuck:
            best = tuple(each.number for each, _ in taken)
            stuck = _open(head)
        if not taken:
            return Verdict(linearizable=False, operations=len(history), steps=steps, order=best, stuck=stuck)
        event, value = taken.pop()
        done &= ~(1 << event.number)
        event.unlift()
        event = event.next
    order = tuple(each.number for each, _ in taken)
    return Verdict(linearizable=True, operations=len(history), steps=steps, order=order)


def _open(head: _Event) -> tuple[int, ...]:
    """The operations called before the first return that is left."""
    found: list[int] = []
    event = head.next
    while event is not None and event.match is not None:
        found.append(event.number)
        event = event.next
    return tuple(found)
