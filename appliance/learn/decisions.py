"""The decisions of rounds for the log: a decider that tells each of its steps, and one that makes them again.

A coordinator's first step (`RoundCase.begin`) has the records that it began with; each further one has the event and
its time. From them the decider is built again, and is asked the same in the same order: a round's decisions rest on all
of its steps before, so a log that lacks one cannot tell what followed. Where a coordinator goes, its successor begins
with records of its own. Of references to files the sizes alone are kept.
"""

import hashlib
import secrets
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from appliance.learn import rounds
from appliance.learn.rounds import Decider, Event, Instruction
from appliance.model import encode
from appliance.model.learning import Order, PartialUpdate, RoundRecord, RunRecord, UpdateRecord
from appliance.tasks.replay import TRACED, Traced

NAME = "round"
"""Under which the steps are put: `gw/{gateway}/decided/round`."""
MOST_LISTED = 32
"""Orders that a line names; of more their digest tells whether they are the same."""
MOST_FOLLOWED = 256
"""Coordinators followed at once while a log is read."""


_BREAKS = (ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError)


class Begin(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a coordinator begins with."""

    run: RunRecord
    record: RoundRecord
    updates: tuple[UpdateRecord, ...] = ()
    apart: tuple[UpdateRecord, ...] = ()
    present: dict[str, str]


class RoundCase(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A step of a round's decider, put as `gw/{gateway}/decided/round`."""

    run: str
    round: int
    coordinator: str
    """Which decider it is a step of; each that takes a round up has an id of its own."""
    step: int
    """From 0, without gaps."""
    now: float
    """Seconds of the coordinator's own clock."""
    begin: Begin | None = None
    """With step 0."""
    event: Event | None = None
    """None: it looked again at this time."""
    decided: tuple[str, ...] = ()
    """The instructions, a line each, with digests of the records in them."""
    waits: str = ""
    """What the round waits for afterwards."""


class TracedDecider(Decider):
    """The decider of a round, which tells each step. Arguments as of `Decider`.

    Args:
        put: takes the steps.
    """

    def __init__(
        self,
        run: RunRecord,
        record: RoundRecord,
        *,
        updates: Iterable[UpdateRecord] = (),
        apart: Iterable[UpdateRecord] = (),
        present: Mapping[str, str],
        now: float,
        put: Callable[[RoundCase], None],
    ) -> None:
        updates, apart = tuple(updates), tuple(apart)
        super().__init__(run, record, updates=updates, apart=apart, present=present, now=now)
        self._put = put
        self._id = secrets.token_hex(6)
        self._step = 0
        self._nested = False
        self._told_begin: Begin | None = Begin(
            run=_lean(run), record=record, updates=tuple(map(_lean_update, updates)),
            apart=tuple(map(_lean_update, apart)), present=dict(present),
        )  # fmt: skip

    def resume(self, now: float) -> list[Instruction]:
        """Begin; as of `Decider`."""
        return self._tell(None, now, lambda: super(TracedDecider, self).resume(now))

    def handle(self, event: Event, now: float) -> list[Instruction]:
        """Take in an event; as of `Decider`."""
        return self._tell(event, now, lambda: super(TracedDecider, self).handle(event, now))

    def advance(self, now: float) -> list[Instruction]:
        """Do what follows; as of `Decider`."""
        return self._tell(None, now, lambda: super(TracedDecider, self).advance(now))

    def _tell(self, event: Event | None, now: float, decide: Callable[[], list[Instruction]]) -> list[Instruction]:
        if self._nested or self.done:
            return decide()
        self._nested = True
        try:
            out = decide()
        finally:
            self._nested = False
        begin, self._told_begin = self._told_begin, None
        self._put(
            RoundCase(
                run=self.run_id, round=self.number, coordinator=self._id, step=self._step, now=now, begin=begin,
                event=None if event is None else _lean_event(event), decided=tuple(map(line, out)), waits=self.waits,
            )
        )  # fmt: skip
        self._step += 1
        return out


def _lean(run: RunRecord) -> RunRecord:
    return replace(run, history=(), models=())


def _lean_update(update: UpdateRecord) -> UpdateRecord:
    return replace(update, parts=tuple(map(_lean_part, update.parts)))


def _lean_part(part: PartialUpdate) -> PartialUpdate:
    """Return a part with the sizes of its files alone: they are counted."""
    sizes = tuple({"bytes": shard["bytes"]} for shard in part.shards if "bytes" in shard)
    return replace(part, manifest={}, shards=sizes)


def _lean_event(event: Event) -> Event:
    match event:
        case rounds.Arrived():
            return rounds.Arrived(event.run, _lean_part(event.update))
        case rounds.Changed():
            return rounds.Changed(_lean(event.run))
        case _:
            return event


def _digest(value: object) -> str:
    return hashlib.blake2b(encode(value), digest_size=6).hexdigest()


def _order(order: Order) -> str:
    helper = f" by {order.helper}" if order.helper else ""
    share = "" if order.share == (0.0, 1.0) else f" share {order.share[0]:.3f}-{order.share[1]:.3f}"
    stop = "" if order.stop_at_s is None else f" stop {order.stop_at_s:.3f} s"
    given_up = " (given up)" if order.given_up else ""
    return f"{order.subtask} of round {order.round}, attempt {order.attempt}{helper}{share}{stop}{given_up}"


def line(instruction: Instruction) -> str:  # noqa: PLR0911 - one line for each instruction
    """Return an instruction in words, with digests of what the words leave out."""
    match instruction:
        case rounds.WriteRound(record):
            orders = "; ".join(map(_order, record.orders[:MOST_LISTED]))
            return f"write round {record.number}, {len(record.orders)} orders [{orders}] {_digest(record)}"
        case rounds.MakeKeys(number, clients):
            return f"make keys for round {number}: {', '.join(clients[:MOST_LISTED])} {_digest(clients)}"
        case rounds.Send(order):
            return f"send {_order(order)} {_digest(order)}"
        case rounds.Cancel(order):
            return f"cancel {_order(order)}"
        case rounds.Ask(order):
            return f"ask {order.gateway} after {_order(order)}"
        case rounds.Accept(number, record):
            parts = ", ".join(f"part {part.part} attempt {part.attempt}" for part in record.parts)
            return f"accept {record.client} for round {number}: {parts} {_digest(_lean_update(record))}"
        case rounds.Refuse(client, reason) | rounds.Exclude(_, client, reason):
            return f"{type(instruction).__name__.lower()} {client}: {reason}"
        case rounds.Aggregate(number, base, shares):
            clients = ", ".join(share.update.client for share in shares[:MOST_LISTED])
            told = [(each.update.client, each.update.part, each.weight, each.scale) for each in shares]
            return f"aggregate round {number} from base {base.digest[:12] or 'none'}: {clients} {_digest(told)}"
        case rounds.Close(result):
            return f"close round {result.record.number}: {result.record.closed_by} {_digest(result)}"


class Again:
    """Makes the steps of rounds again, in the order of a log."""

    def __init__(self) -> None:
        self._deciders: dict[str, tuple[Decider, int]] = {}
        """Coordinator -> its decider, and the step that comes next."""

    def decide(self, case: RoundCase) -> dict[str, Any] | None:
        """Return what is decided now, by the names of the case's fields; None where steps before it are missing."""
        decider, step = self._deciders.get(case.coordinator, (None, 0))
        if case.begin is None and (decider is None or case.step < step):
            return None  # of the latter kind it was put, and logged, twice
        self._deciders.pop(case.coordinator, None)
        if case.begin is None and step != case.step:
            return None
        try:
            decider, out = _decide(decider, case)
        except _BREAKS as error:  # what breaks the decider now has not broken it then: that is a difference
            return {"decided": (f"the decider breaks: {error!r}",), "waits": case.waits}
        if not decider.done:
            self._deciders[case.coordinator] = (decider, case.step + 1)
            if len(self._deciders) > MOST_FOLLOWED:
                del self._deciders[next(iter(self._deciders))]
        return {"decided": tuple(map(line, out)), "waits": decider.waits}


def _decide(decider: Decider | None, case: RoundCase) -> tuple[Decider, list[Instruction]]:
    if case.begin is not None or decider is None:
        begin = case.begin
        assert begin is not None  # noqa: S101 - the caller has one of both
        decider = Decider(
            begin.run, begin.record, updates=begin.updates, apart=begin.apart, present=begin.present, now=case.now
        )
        return decider, decider.resume(case.now)
    return decider, decider.advance(case.now) if case.event is None else decider.handle(case.event, case.now)


def all_traced() -> dict[str, Traced]:
    """Return the deciders whose decisions `tasks.replay.check` makes again: those of tasks, pools and rounds."""
    what = "step {0.step} of round {0.round} of run {0.run} ({0.coordinator})"
    return {**TRACED, NAME: Traced(RoundCase, Again().decide, what.format)}
