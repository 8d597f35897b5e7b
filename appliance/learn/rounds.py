"""What the coordinator of a round decides: events in, instructions out, without I/O.

`Decider` has the run's record, the round's, and what the coordinator knows beside them. Each event and `advance` return
instructions, which the shell (`coordinator`), or a simulator, carries out in their order. Times are seconds of one
monotonic clock and passed in.

- **Choice**: of the clients that are there, not excluded and not still at work for an earlier round. Those that were
  left out for `fair_after` rounds come first, the longest of them before the others; then chance, from the run's seed.
- **Deadline**: 1.3 times the median of what the clients take for a whole epoch, as learned in earlier rounds; in the
  first one, of those that have answered, once half have.
- **Modes** (`model.learning.Mode`): `sync` waits for all. `buffered` closes when so many have answered. `partial` tells
  clients to stop at the deadline. `offload` gives a slow client what it can do by then, and the rest of its samples,
  in parts of at most half, to clients that are idle; the parts are summed and count as the client's.
- **Late updates**: an order that is open when its round closes is carried on. Its update counts in the round in which
  it comes, with weight n/sqrt(1 + staleness), or not at all after `max_staleness` rounds. Its client is not chosen
  meanwhile.
- **Once**: an order is one client, round and part. Of its attempts only the last one's update is taken, and only one.
- **Failures**: an attempt that fails is made again, `ATTEMPTS` times in all. One that failed for what passes (a gateway
  that restarts, no room) does not count as one of those: it is made again after a pause until `timeout_s` is over.
- **Refusals**: an update that is unfit, by what it says or where it is summed, counts for nothing. A client refused
  twice in a row is excluded: when the round closes, or within the round (`Exclude`) where it is ordered again because
  too few are left. Orders and accepted updates carry the number, so that a successor goes on counting.
- **Secure aggregation**: the clients of a cohort agree on masks (`MakeKeys`) before they are sent their orders. Of them
  a majority has to answer (`secagg.threshold`); with fewer another cohort agrees on new masks and trains anew.
- **Closing**: a round that has what it waits for has its updates aggregated. An update that is left out through no
  fault of its client (its files are lost, multi-Krum averages others) does not count either, and excludes nobody. Where
  too few are left for a model, the round goes on: with clients that were not chosen, then with those whose updates were
  left out or refused. What a run's record becomes when a round closes is `closed`; a round that cannot close says what
  it waits for.
"""

import math
import random
from collections import Counter
from collections.abc import Iterable, Mapping
from heapq import nsmallest
from statistics import median
from typing import NamedTuple

from msgspec import Struct, field
from msgspec.structs import replace

from appliance.learn.privacy import epsilon
from appliance.learn.secagg import threshold
from appliance.model.learning import (
    ClientState,
    Closed,
    Cohort,
    Counted,
    Mode,
    Model,
    Order,
    PartialUpdate,
    Reference,
    RoundRecord,
    RunRecord,
    RunState,
    UpdateRecord,
)
from appliance.skills._lib.learning.seeds import seed
from appliance.skills._lib.learning.weights import stale_weight

ATTEMPTS = 3
"""At one client's work for a round."""
REFUSALS = 2
"""Refused updates in a row after which a client is excluded."""
GRACE = 0.25
"""Of the deadline: how much longer a round waits for what stopped at the deadline, for the way of the update."""
GRACE_S = 2.0
OFFLOAD_LIMIT = 2.0
"""Deadlines after which a round waits for offloaded parts no more: they begin when a client is idle."""
LARGEST_PART = 0.5
"""Of a client's samples that a helper gets at once: small parts averaged in like clients cost accuracy."""
MOST_LISTED = 1 << 17
"""Samples of a client above which nothing is offloaded: an order for a share of them lists their positions."""
MOST_SCALED = 10.0
"""An update of less than a tenth of its epoch is not enlarged to the whole: it would be mostly noise."""
MOST_SAMPLES = 1 << 30
SMOOTHING = 0.5
"""Weight of the last round in what an epoch takes a client."""
RETRY_S = 1.0
LONGEST_RETRY_S = 30.0
HISTORY = 200
"""Rounds in a run's history."""

_EPSILON = 1e-6

Key = tuple[str, int, int]
"""An order: client, round, part."""


# --- events


class Ordered(Struct, frozen=True, tag=True):
    """An order was taken by a gateway."""

    key: Key
    attempt: int
    gateway: str


class Arrived(Struct, frozen=True, tag=True):
    """An update has come. Told again, it changes nothing."""

    run: str
    update: PartialUpdate


class Failed(Struct, frozen=True, tag=True):
    """An attempt at an order has ended without an update.

    Attributes:
        key: the order.
        attempt: which.
        reason: in words.
        retryable: whether another attempt may go otherwise.
        transient: whether it failed for what passes by itself, such as a gateway that restarts.
    """

    key: Key
    attempt: int
    reason: str
    retryable: bool = True
    transient: bool = False


class Waiting(Struct, frozen=True, tag=True):
    """An attempt cannot begin yet: no gateway has room for it, or none is there."""

    key: Key
    attempt: int
    reason: str


class Present(Struct, frozen=True, tag=True):
    """A client is there, at a gateway."""

    client: str
    gateway: str = ""


class Lost(Struct, frozen=True, tag=True):
    """A client is not there any more."""

    client: str


class Keyed(Struct, frozen=True, tag=True):
    """The clients of a cohort have agreed on masks (`MakeKeys`)."""

    cohort: Cohort


class Unkeyed(Struct, frozen=True, tag=True):
    """They have not."""

    reason: str


class Changed(Struct, frozen=True, tag=True):
    """The run's record was changed: paused, resumed, stopped, a client excluded."""

    run: RunRecord


class Aggregated(Struct, frozen=True, tag=True):
    """The updates have become a model.

    Attributes:
        model: without its number.
        refused: client -> why its update is unfit.
        left_out: client -> why its update, which may be fit, is not in the model.
    """

    model: Model
    refused: Mapping[str, str]
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])


class TooFew(Struct, frozen=True, tag=True):
    """Of the updates too few are left to make a model of.

    Attributes:
        needed: updates that the rule needs.
        refused: as of `Aggregated`.
        left_out: as of `Aggregated`.
    """

    needed: int
    refused: Mapping[str, str]
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])


class AggregateFailed(Struct, frozen=True, tag=True):
    """They have not."""

    reason: str


Event = (
    Ordered
    | Arrived
    | Failed
    | Waiting
    | Present
    | Lost
    | Keyed
    | Unkeyed
    | Changed
    | Aggregated
    | TooFew
    | AggregateFailed
)


# --- instructions


class WriteRound(NamedTuple):
    """Write the round's record before what follows."""

    record: RoundRecord


class MakeKeys(NamedTuple):
    """Have the clients of a cohort agree on masks, before they are sent their orders; answered by an event."""

    number: int
    clients: tuple[str, ...]


class Send(NamedTuple):
    """Have a client, or its helper, begin an attempt."""

    order: Order


class Cancel(NamedTuple):
    """End an attempt; nothing of it will count."""

    order: Order


class Ask(NamedTuple):
    """Ask what became of an attempt that another coordinator sent."""

    order: Order


class Accept(NamedTuple):
    """Write an update's record; only then has it been accepted."""

    number: int
    record: UpdateRecord


class Refuse(NamedTuple):
    """An update does not count; for the log and the counters."""

    client: str
    reason: str


class Share(NamedTuple):
    """An update as it is summed. Those of one client are parts of one whole."""

    update: PartialUpdate
    weight: int
    scale: tuple[int, int]


class Exclude(NamedTuple):
    """Change the run's record by `excluded`: a client takes part no more, from this round on."""

    number: int
    client: str
    reason: str


class Aggregate(NamedTuple):
    """Make the next model of these."""

    number: int
    base: Model
    shares: tuple[Share, ...]


class Result(NamedTuple):
    """A closed round, and what it means for the run's record (`closed`)."""

    record: RoundRecord
    model: Model
    patches: "Mapping[str, Patch]"
    took_s: float
    all_s: float
    """What waiting for all of the cohort would have taken, by what is known of them."""
    classes: tuple[str, ...] = ()
    """Of the data that the model was trained on."""


class Close(NamedTuple):
    """Change the run's record by `closed`, then write the round's, then open the next (`opened`)."""

    result: Result


Instruction = WriteRound | MakeKeys | Send | Cancel | Ask | Accept | Refuse | Exclude | Aggregate | Close


class Patch(NamedTuple):
    """What a round says of a client."""

    chosen: bool = False
    epoch_s: float | None = None
    samples: int = 0
    loss: float | None = None
    counted: bool = False
    refused: str = ""
    """Why the last one was, of the updates that were refused."""
    refusals: int = 0
    """Updates that were refused in a row."""
    note: str = ""
    sent_bytes: int = 0
    residual: tuple[tuple[Reference, ...], ...] = ()
    residual_round: int = 0


# --- the run's record


def closed(run: RunRecord, result: Result, *, now_ns: int) -> RunRecord | None:
    """Return a run's record after a round; None where that round is closed already, or the run has ended."""
    record = result.record
    if run.round != record.number or run.state.final:
        return None
    clients = tuple(
        client if (patch := result.patches.get(client.name)) is None else _patched(client, patch, record.number)
        for client in run.clients
    )
    counted = [each for each in record.counted if not each.refused]
    samples = sum(each.samples for each in counted)
    known = [(each.loss, each.samples) for each in counted if each.loss is not None]
    line = Closed(
        number=record.number,
        took_s=round(result.took_s, 3),
        all_s=round(result.all_s, 3),
        clients=len(counted),
        samples=samples,
        loss=sum(loss * count for loss, count in known) / total
        if (total := sum(count for _, count in known))
        else None,
        digest=result.model.digest,
        why=record.closed_by,
        sent_bytes=sum(each.sent_bytes for each in counted),
        epsilon=_epsilon(run, clients),
    )
    last = record.number >= run.recipe.rounds.count
    return replace(
        run,
        state=RunState.SUCCEEDED if last and run.state is RunState.RUNNING else run.state,
        round=record.number if last else record.number + 1,
        why="all rounds are done" if last else run.why,
        model=result.model,
        models=kept_models((*run.models, result.model), run.recipe.keep_models),
        clients=clients,
        classes=run.classes or result.classes,
        apart=tuple(number for number in run.apart if number not in record.merged),
        history=(*run.history, line)[-HISTORY:],
        updated_ns=now_ns,
    )


def _epsilon(run: RunRecord, clients: Iterable[ClientState]) -> float | None:
    """ε of a run's models for the client that took part most often; None without differential privacy."""
    dp = run.recipe.update.dp
    if dp is None:
        return None
    return epsilon(dp.noise, max((client.rounds for client in clients), default=0), dp.delta)


def kept_models(models: tuple[Model, ...], keep: int) -> tuple[Model, ...]:
    """Return the newest models and those that are marked."""
    newest = {model.number for model in models[-keep:]}
    return tuple(model for model in models if model.marked or model.number in newest)


def _too_often(refused: int, reason: str) -> str:
    """Why a client is excluded whose updates were refused."""
    return f"{refused} updates refused in a row, the last: {reason}"[:200]


def excluded(run: RunRecord, exclude: Exclude, *, now_ns: int) -> RunRecord | None:
    """Return a run's record without a client; None where it is excluded already, or the round is over."""
    if run.round != exclude.number or run.state.final:
        return None
    clients = tuple(
        replace(client, excluded=exclude.reason, note=exclude.reason)
        if client.name == exclude.client and not client.excluded
        else client
        for client in run.clients
    )
    return None if clients == run.clients else replace(run, clients=clients, updated_ns=now_ns)


def _patched(client: ClientState, patch: Patch, number: int) -> ClientState:
    refused = 0 if patch.counted else client.refused + patch.refusals
    excluded = client.excluded
    if refused >= REFUSALS and not excluded:
        excluded = _too_often(refused, patch.refused)
    return replace(
        client,
        epoch_s=client.epoch_s if patch.epoch_s is None else patch.epoch_s,
        samples=patch.samples or client.samples,
        rounds=client.rounds + patch.counted,
        chosen=number if patch.chosen else client.chosen,
        refused=refused,
        excluded=excluded,
        loss=client.loss if patch.loss is None else patch.loss,
        note=patch.refused or patch.note,
        sent_bytes=patch.sent_bytes if patch.counted else client.sent_bytes,
        residual=patch.residual if patch.counted else client.residual,
        residual_round=patch.residual_round if patch.counted else client.residual_round,
    )


def evaluated(run: RunRecord, number: int, *, accuracy: float, loss: float | None, now_ns: int) -> RunRecord:
    """Return a run's record with what a model's evaluation gave; at the target the run has succeeded."""
    target = run.recipe.rounds.target

    def told(model: Model) -> Model:
        return replace(model, accuracy=accuracy, loss=loss) if model.number == number else model

    history = tuple(replace(line, accuracy=accuracy) if line.number == number else line for line in run.history)
    reached = target is not None and accuracy >= target and not run.state.final
    return replace(
        run,
        model=told(run.model),
        models=tuple(told(model) for model in run.models),
        history=history,
        state=RunState.SUCCEEDED if reached else run.state,
        why=f"accuracy {accuracy:.3f} of model {number} has reached the target {target:g}" if reached else run.why,
        updated_ns=now_ns,
    )


def opened(result: Result) -> RoundRecord:
    """Return the record of the round after one that is closed: its base, and the orders that are still awaited."""
    record = result.record
    # What was refused of them is counted in the run's record.
    late = tuple(replace(order, ordered_s=0.0, refused=0) for order in record.orders if not order.given_up)
    return RoundRecord(run=record.run, number=record.number + 1, base=result.model, orders=late)


def rebased(record: RoundRecord, updates: Iterable[UpdateRecord], base: Model) -> RoundRecord:
    """Return the record of an open round that begins with another model: what was trained is trained again.

    After a partition in which both sides closed as many rounds, the open round may be that of the side whose model does
    not stand. Its updates are of another base, and of late ones it is not known whether the model has them already:
    none counts. Orders become the next attempt, so that gateways do not answer with what they have.
    """
    done = (
        Order(client=part.client, round=part.round, part=part.part, share=part.share, helper=part.helper,
              attempt=part.attempt, refused=part.refused, stop_at_s=record.deadline_s)
        for update in updates
        for part in update.parts
    )  # fmt: skip
    last: dict[Key, Order] = {}
    for order in (*record.orders, *done):
        known = last.get(_key(order))
        if order.round == record.number and (known is None or known.attempt < order.attempt):
            last[_key(order)] = order
    orders = tuple(
        order if order.given_up else replace(order, attempt=order.attempt + 1, gateway="", ordered_s=0.0)
        for order in last.values()
    )
    return replace(record, base=base, orders=orders, elapsed_s=0.0, waits="", cohort=None)


# --- the decider


class Decider:
    """Decides for one round.

    Args:
        run: the run's record; the round is its `round`.
        record: the round's.
        updates: those that are accepted already.
        apart: updates that another side of a partition has accepted (`records.unclaimed`).
        present: client -> its gateway, of those that are there.
        now: the time.
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
    ) -> None:
        self._run = run
        self._apart = tuple(apart)
        self._record = record
        self._opened = now - record.elapsed_s
        self._present = dict(present)
        self._clients = {client.name: client for client in run.clients}
        self._orders: dict[Key, Order] = {_key(order): order for order in record.orders}
        self._parts: dict[str, dict[int, PartialUpdate]] = {
            update.client: {part.part: part for part in update.parts}
            for update in updates
            if update.parts and ((known := self._clients.get(update.client)) is None or not known.excluded)
        }
        for client, parts in self._parts.items():
            for part in parts.values():
                self._orders.pop((client, part.round, part.part), None)
        self._offered: list[Order] = []
        self._later: dict[Key, float] = {}
        """Orders that are sent again, and when."""
        self._pauses: dict[Key, int] = {}
        """Order -> how often it was put off in this round."""
        self._reasons: dict[Key, str] = {}
        """Order -> why it has not begun."""
        self._least = run.recipe.rounds.at_least
        self._patches: dict[str, Patch] = {
            client: Patch(chosen=True) for client, number, _ in self._orders if number == record.number
        }
        # What was refused stands in the orders that were made again, and in what has come of them.
        refusals = [(order.client, order.refused, order.given_up) for order in self._orders.values()]
        refusals += [(client, part.refused, "") for client, parts in self._parts.items() for part in parts.values()]
        for client, count, reason in refusals:
            patch = self._patches.get(client, Patch())
            if count > patch.refusals:
                self._patches[client] = patch._replace(refused=reason, refusals=count, note=reason)
        for client in self._parts:
            self._learn(client)
        self._deadline = record.deadline_s
        self._aggregating = False
        self._keying = False
        """Whether the cohort agrees on masks just now."""
        self._secure = run.recipe.update.secagg
        if record.cohort is not None:
            self._least = max(self._least, threshold(len(record.cohort.clients)))
        self._failures = 0
        self._again_at: float | None = None
        self._stuck_at: float | None = None
        self._stuck = 0
        self._waits = ""
        self.done = False
        """Whether the round is closed, or nothing follows for another reason."""

    # --- what is seen -------------------------------------------------------------------------------------------

    @property
    def run_id(self) -> str:
        """Of the run."""
        return self._run.id

    @property
    def number(self) -> int:
        """Of the round."""
        return self._record.number

    @property
    def waits(self) -> str:
        """What the round waits for, in words."""
        return self._waits

    @property
    def orders(self) -> tuple[Order, ...]:
        """Those whose updates are awaited."""
        return tuple(order for order in self._orders.values() if not order.given_up)

    @property
    def accepted(self) -> frozenset[str]:
        """Clients whose updates are accepted, or parts of them."""
        return frozenset(client for client, parts in self._parts.items() if parts)

    def order(self, key: Key) -> Order | None:
        """Return an order that is awaited."""
        found = self._orders.get(key)
        return None if found is None or found.given_up else found

    def record(self, now: float) -> RoundRecord:
        """Return the round's record as it stands."""
        return replace(
            self._record,
            orders=tuple(self._orders.values()),
            elapsed_s=round(now - self._opened, 3),
            deadline_s=self._deadline,
            waits=self._waits,
        )

    # --- events -------------------------------------------------------------------------------------------------

    def resume(self, now: float) -> list[Instruction]:
        """Begin, perhaps where another coordinator ended: its orders are asked after."""
        out: list[Instruction] = []
        for order in self.orders:
            out += [Ask(order)] if order.gateway else self._send([order])
        if self._run.recipe.mode is Mode.OFFLOAD:
            self._offer_again(now)
        return [*out, *self.advance(now)]

    def _offer_again(self, now: float) -> None:
        """Offer those of the cohort's samples that no order covers: what was offered is in no record."""
        given: dict[str, list[tuple[int, tuple[float, float]]]] = {}
        for order in self._orders.values():
            if order.round == self.number:
                given.setdefault(order.client, []).append((order.part, order.share))
        for client, parts in self._parts.items():
            here = [(part.part, part.share) for part in parts.values() if part.round == self.number]
            given.setdefault(client, []).extend(here)
        for client, shares in given.items():
            number, at = max((part for part, _ in shares), default=0), 0.0 if shares else 1.0
            for low, high in sorted(share for _, share in shares):
                if low - at > _EPSILON:
                    number += 1
                    self._offer(client, number, (at, low), now)
                at = max(at, high)
            if 1.0 - at > _EPSILON:
                self._offer(client, number + 1, (at, 1.0), now)

    def _offer(self, client: str, part: int, share: tuple[float, float], now: float) -> None:
        at = round(now - self._opened, 3)
        self._offered.append(Order(client=client, round=self.number, part=part, share=share, ordered_s=at))

    def handle(self, event: Event, now: float) -> list[Instruction]:
        """Take in an event, and do what follows."""
        if self.done:
            return []
        out: list[Instruction] = []
        match event:
            case Ordered():
                self._taken(event)
            case Arrived():
                out = self._arrived(event)
            case Failed():
                out = self._failed(event, now)
            case Waiting():
                order = self.order(event.key)
                if order is not None and order.attempt == event.attempt:
                    self._reasons[event.key] = event.reason[:200]
            case Present():
                out = self._back(event, now)
            case Lost():
                self._present.pop(event.client, None)
                self._give_up_client(event.client, f"{event.client} is not there")
            case Keyed():
                out = self._keyed(event.cohort, now)
            case Unkeyed():
                self._unkeyed(event.reason, now)
            case Changed():
                out = self._changed(event.run, now)
            case Aggregated():
                return self._aggregated(event, now)
            case TooFew():
                out = self._too_few(event, now)
            case AggregateFailed():
                self._aggregating = False
                self._put_off(now)
                self._waits = f"aggregation is tried again: {event.reason}"
        return [*out, *self.advance(now)]

    def _put_off(self, now: float) -> None:
        """Do nothing for a while, each time for longer."""
        self._failures += 1
        self._again_at = now + min(LONGEST_RETRY_S, RETRY_S * 2 ** (self._failures - 1))

    def advance(self, now: float) -> list[Instruction]:
        """Do what follows from the state and the time."""
        if self.done or self._aggregating or self._run.state is not RunState.RUNNING:
            return []
        if self._again_at is not None and now < self._again_at:
            return []
        out: list[Instruction] = []
        if not self._record.target:
            out += self._choose(now)
        out += self._time_out(now)
        out += self._send_again(now)
        out += self._extend(now)
        if self._secure and self._record.target and self._record.cohort is None:
            out += self._send(self.orders)
        self._follow_deadline()
        out += self._help(now)
        if self._ready(now) and (refused := self._refuse_other_classes(now)):
            out += [*refused, *self._extend(now)]
        if why := self._ready(now):
            return [*out, *self._aggregate(why, now)]
        return out

    def next_at(self, now: float) -> float | None:
        """When to look again if nothing happens; None: only an event helps."""
        if self._again_at is not None and now < self._again_at:
            return self._again_at  # nothing else is looked at before: to be woken for it would be in vain
        due: list[float] = []
        if self._record.target and not self._aggregating:
            limit = self._limit()
            if limit is not None:
                due.append(self._opened + limit)
            if self._stuck_at is not None:
                due.append(self._stuck_at)
            if self._run.state is RunState.RUNNING:
                due += [max(at, now + _EPSILON) for at in self._later.values()]
            if orders := self.orders:
                timeout = self._run.recipe.rounds.timeout_s
                due.append(min(self._opened + order.ordered_s + timeout for order in orders))
        later = [at for at in due if at > now]
        return min(later, default=None)

    # --- choosing -----------------------------------------------------------------------------------------------

    def _eligible(self) -> list[str]:
        busy = {client for client, _, _ in self._orders} | self._parts.keys()
        busy |= {order.helper for order in self.orders if order.helper}
        return [
            name
            for name, client in self._clients.items()
            if name in self._present and not client.excluded and name not in busy
        ]

    def _choose(self, now: float) -> list[Instruction]:
        """Choose the cohort, and order its work."""
        recipe = self._run.recipe
        out = [*self._too_late(), *self._take_in_apart()]
        eligible = self._eligible()
        taking_part = sum(not client.excluded for client in self._clients.values())
        wanted = min(recipe.clients.per_round or taking_part, taking_part)
        if not eligible and self._parts:  # what the other side of a partition has trained is all there is
            self._record, self._waits = replace(self._record, target=1), ""
            return [*out, WriteRound(self.record(now))]
        if not eligible:
            self._waits = self._nobody()
            return out
        chosen = self._pick(eligible, math.ceil(wanted * recipe.clients.over_selection))
        # Late updates fill a buffer too: that clients are still at work makes it no smaller.
        target = wanted if recipe.mode is Mode.BUFFERED else min(wanted, len(chosen))
        self._record = replace(self._record, target=target)
        self._waits = ""
        self._deadline = self._known_deadline(chosen)
        for client in chosen:
            self._patches[client] = self._patches.get(client, Patch())._replace(chosen=True)
        orders = [order for client in chosen for order in self._work(client, now)]
        self._orders |= {_key(order): order for order in orders}
        return [*out, WriteRound(self.record(now)), *self._send(orders)]

    def _send(self, orders: Iterable[Order]) -> list[Instruction]:
        """Send orders; those of a cohort that has no masks yet once it has them."""
        orders = list(orders)
        if not self._secure or self._record.cohort is not None:
            return [Send(order) for order in orders]
        if self._keying or not orders:
            return []
        self._keying = True
        return [MakeKeys(self.number, tuple(sorted({order.client for order in self.orders})))]

    def _keyed(self, cohort: Cohort, now: float) -> list[Instruction]:
        """The cohort has masks: its orders are sent, and nobody comes to it any more."""
        if not self._keying:
            return []
        self._keying, self._failures = False, 0
        self._record = replace(self._record, cohort=cohort)
        self._least = max(self._least, threshold(len(cohort.clients)))
        known = {each.client for each in cohort.clients}
        for order in self.orders:
            if order.client not in known:
                self._dropped(order, "it has no keys of this round")
            self._reasons.pop(_key(order), None)
        return [WriteRound(self.record(now)), *self._send(self.orders)]

    def _unkeyed(self, reason: str, now: float) -> None:
        if self._keying:
            self._keying = False
            self._put_off(now)
            self._reasons |= {_key(order): f"no masks yet: {reason}"[:200] for order in self.orders}
            self._waits = self._waiting_for(self._open_of_cohort())

    def _take_in_apart(self) -> list[Instruction]:
        """Count what another side of a partition has accepted as late updates: with `sync` no late one counts."""
        if self._record.merged or not self._run.apart:
            return []
        self._record = replace(self._record, merged=self._run.apart)
        out: list[Instruction] = []
        for update in self._apart if self._run.recipe.mode is not Mode.SYNC else ():
            known = self._clients.get(update.client)
            if known is None or known.excluded or any(_problem(part, self._run) for part in update.parts):
                continue
            numbers = {part.round for part in update.parts}
            mine = [order for order in self.orders if order.client == update.client]
            if update.client in self._parts or any(order.round not in numbers for order in mine):
                continue
            for order in mine:  # the same work, ordered here too
                out += [Cancel(order), *self._dropped(order, "the other side of the partition has its update")]
            self._parts[update.client] = {part.part: part for part in update.parts}
            self._learn(update.client)
            out.append(Accept(self.number, update))
        return out

    def _too_late(self) -> list[Instruction]:
        """End what is so many rounds late that it cannot count any more."""
        most = self._run.recipe.rounds.max_staleness
        late = [order for order in self.orders if self.number - order.round > most]
        for order in late:
            self._dropped(order, f"more than {most} rounds late")
        return [Cancel(order) for order in late]

    def _pick(self, eligible: list[str], count: int) -> list[str]:
        fair = self._run.recipe.clients.fair_after
        chance = random.Random(seed(self._run.recipe.seed, self.number, "", "choice"))  # noqa: S311 - no secret

        def rank(name: str) -> tuple[int, float]:
            left_out = self.number - 1 - self._clients[name].chosen
            return (-left_out if left_out >= fair else 0, chance.random())

        ranked = [(rank(name), name) for name in eligible]
        return sorted(name for _, name in nsmallest(count, ranked))

    def _known_deadline(self, chosen: list[str]) -> float | None:
        """The deadline by what is known of the cohort; None where that is of fewer than half, or none is wanted."""
        if self._run.recipe.mode not in (Mode.PARTIAL, Mode.OFFLOAD):
            return None
        known = [epoch_s for client in chosen if (epoch_s := self._clients[client].epoch_s) is not None]
        if not known or 2 * len(known) < len(chosen):
            return None
        return self._run.recipe.rounds.deadline * median(known)

    def _work(self, client: str, now: float) -> list[Order]:
        """The order of a client; what it cannot do by the deadline is offered to others."""
        order = Order(
            client=client,
            round=self.number,
            refused=self._patches.get(client, Patch()).refusals,
            stop_at_s=self._deadline,
            ordered_s=round(now - self._opened, 3),
        )
        epoch_s, samples = self._clients[client].epoch_s, self._clients[client].samples
        if self._run.recipe.mode is not Mode.OFFLOAD or self._deadline is None or not epoch_s:
            return [order]
        if not 1 < samples <= MOST_LISTED:
            return [order]
        own = min(1.0, self._deadline / epoch_s)
        if own >= 1.0:
            return [order]
        parts = math.ceil((1.0 - own) / LARGEST_PART)
        cuts = [own + (1.0 - own) * number / parts for number in range(parts + 1)]
        for number in range(parts):
            self._offer(client, number + 1, (cuts[number], cuts[number + 1]), now)
        return [replace(order, share=(0.0, own))]

    def _nobody(self) -> str:
        there = [name for name in self._clients if name in self._present]
        if not there:
            return "no client is there"
        excluded = sum(bool(self._clients[name].excluded) for name in there)
        if excluded == len(there):
            return f"all {excluded} clients that are there are excluded"
        return "all clients are at work for an earlier round, or are excluded"

    # --- helpers ------------------------------------------------------------------------------------------------

    def _help(self, now: float) -> list[Instruction]:
        """Give offered parts to idle clients, the fastest first."""
        sent: list[Order] = []
        while self._offered:
            found = self._helper(self._offered[0].client)
            if found is None:
                break
            order = replace(self._offered.pop(0), helper=found, ordered_s=round(now - self._opened, 3))
            self._orders[_key(order)] = order
            sent.append(order)
        return [WriteRound(self.record(now)), *self._send(sent)] if sent else []

    def _helper(self, client: str) -> str | None:
        """The fastest client that has nothing to do and may see another's samples."""
        busy = {order.helper or order.client for order in self.orders} | {client}
        place = self._present.get(client) if self._run.recipe.data.share == "gateway" else None
        slow = {order.client for order in (*self._offered, *self.orders) if order.part}
        idle = [
            (known.epoch_s or math.inf, name)
            for name, gateway in self._present.items()
            if (known := self._clients.get(name)) is not None
            and name not in busy
            and name not in slow
            and not known.excluded
            and (place is None or place == gateway)
        ]
        return min(idle)[1] if idle else None

    # --- orders -------------------------------------------------------------------------------------------------

    def _taken(self, event: Ordered) -> None:
        order = self._orders.get(event.key)
        if order is not None and order.attempt == event.attempt:
            self._orders[event.key] = replace(order, gateway=event.gateway)
            self._reasons.pop(event.key, None)

    def _failed(self, event: Failed, now: float) -> list[Instruction]:
        order = self.order(event.key)
        if order is None or order.attempt != event.attempt:
            return []
        order = replace(order, failures=order.failures + (not event.transient))
        doer = order.helper or order.client
        if not event.retryable or order.failures >= ATTEMPTS or doer not in self._present:
            return self._dropped(order, event.reason)
        # What passes may take longer than the attempts: their time is not begun again, so that it has an end.
        ordered_s = order.ordered_s if event.transient else round(now - self._opened, 3)
        again = replace(order, attempt=order.attempt + 1, gateway="", ordered_s=ordered_s)
        self._orders[event.key] = again
        self._reasons[event.key] = event.reason[:200]
        if not event.transient and self._run.state is RunState.RUNNING:
            return [WriteRound(self.record(now)), *self._send([again])]
        self._pauses[event.key] = self._pauses.get(event.key, 0) + 1
        pause = min(LONGEST_RETRY_S, RETRY_S * 2 ** min(10, self._pauses[event.key] - 1)) if event.transient else 0.0
        self._later[event.key] = now + pause
        return [WriteRound(self.record(now))]

    def _send_again(self, now: float) -> list[Instruction]:
        """Send the orders that were put off, when they are due."""
        due = sorted(key for key, at in self._later.items() if at <= now)
        for key in due:
            del self._later[key]
        return self._send(order for key in due if (order := self.order(key)) is not None and not order.gateway)

    def _dropped(self, order: Order, reason: str) -> list[Instruction]:
        """An order is not awaited any more."""
        key = _key(order)
        self._orders[key] = replace(order, given_up=reason[:200] or "no reason given")
        self._later.pop(key, None)
        self._reasons.pop(key, None)
        if not order.part:
            patch = self._patches.get(order.client, Patch())
            self._patches[order.client] = patch._replace(note=reason[:200])
        return []

    def _give_up_client(self, name: str, reason: str) -> None:
        for order in self.orders:
            if (order.helper or order.client) == name:
                if order.helper and order.failures + 1 < ATTEMPTS:
                    # Another helper can do it.
                    del self._orders[_key(order)]
                    self._later.pop(_key(order), None)
                    again = replace(order, helper="", gateway="", attempt=order.attempt + 1)
                    self._offered.append(replace(again, failures=order.failures + 1))
                else:
                    self._dropped(order, reason)

    def _back(self, event: Present, now: float) -> list[Instruction]:
        """A client is there: it goes on with what it was given, if it can finish."""
        new = event.client not in self._present
        self._present[event.client] = event.gateway
        known = self._clients.get(event.client)
        if not new or self._aggregating or self._run.state is not RunState.RUNNING:
            return []
        if known is None or known.excluded or not self._may_go_on(event):
            return []
        out: list[Instruction] = []
        for key, order in list(self._orders.items()):
            if key[0] != event.client or not order.given_up or order.helper or order.failures >= ATTEMPTS:
                continue
            if self._fits(order, now):
                again = replace(
                    order, given_up="", gateway="", attempt=order.attempt + 1, ordered_s=round(now - self._opened, 3)
                )
                self._orders[key] = again
                out += self._send([again])
        return [WriteRound(self.record(now)), *out] if out else []

    def _may_go_on(self, event: Present) -> bool:
        """Whether a client that is back has its masks: they are at the gateway where it was."""
        if not self._secure:
            return True
        cohort = self._record.cohort
        return cohort is not None and (event.client, event.gateway) in {
            (each.client, each.gateway) for each in cohort.clients
        }

    def _extend(self, now: float) -> list[Instruction]:
        """A round that too few of its cohort answer takes others, then tries those that failed again."""
        missing = self._least - len(self._counted())
        if not self._record.target or missing <= 0 or self._open_of_cohort():
            self._stuck_at = None
            return []
        if self._secure:
            return self._begin_again(now)
        chosen = self._pick(self._eligible(), missing)
        orders = [order for client in chosen for order in self._work(client, now)]
        for client in chosen:
            self._patches[client] = self._patches.get(client, Patch())._replace(chosen=True)
        if not orders:
            if self._pauses_for(now):
                return []
            orders = self._made_again(now)
        self._orders |= {_key(order): order for order in orders}
        return [WriteRound(self.record(now)), *self._send(orders)] if orders else []

    def _pauses_for(self, now: float) -> bool:
        """Whether a round that nobody answers waits, each time for longer, before those that failed try again."""
        if self._stuck_at is None:
            self._stuck += 1
            self._stuck_at = now + min(LONGEST_RETRY_S, RETRY_S * 2 ** min(10, self._stuck))
        if now < self._stuck_at:
            return True
        self._stuck_at = None
        return False

    def _made_again(self, now: float) -> list[Order]:
        """The orders of the round whose clients do not count, once more."""
        at = round(now - self._opened, 3)
        return [
            replace(order, given_up="", gateway="", attempt=order.attempt + 1, ordered_s=at)
            for order in self._orders.values()
            if order.client in self._present
            and not order.part
            and order.client not in self._parts
            and not self._clients[order.client].excluded
        ]

    def _begin_again(self, now: float) -> list[Instruction]:
        """A cohort of which too few are left: masks cancel for its own clients only, so another one trains anew."""
        if self._pauses_for(now):
            return []
        out: list[Instruction] = []
        for client, parts in sorted(self._parts.items()):
            own = parts[0]
            self._orders[(client, self.number, 0)] = Order(
                client=client, round=self.number, attempt=own.attempt, refused=own.refused, given_up="too few were left"
            )
            out.append(Accept(self.number, UpdateRecord(client=client)))
        self._parts.clear()
        chosen = self._pick(self._eligible(), max(0, self._record.target - len(self._orders)))
        for client in chosen:
            self._patches[client] = self._patches.get(client, Patch())._replace(chosen=True)
        orders = [*self._made_again(now), *(order for client in chosen for order in self._work(client, now))]
        self._orders |= {_key(order): order for order in orders}
        self._record = replace(self._record, cohort=None)
        self._keying = False
        self._least = self._run.recipe.rounds.at_least
        return [*out, WriteRound(self.record(now)), *self._send(orders)]

    def _fits(self, order: Order, now: float) -> bool:
        """Whether a client that comes back can finish before the round closes without it."""
        epoch_s, limit = self._clients[order.client].epoch_s, self._limit()
        if limit is None or epoch_s is None:
            return True
        left = self._opened + limit - now
        return left > 0 and (order.stop_at_s is not None or epoch_s * (order.share[1] - order.share[0]) <= left)

    def _time_out(self, now: float) -> list[Instruction]:
        timeout = self._run.recipe.rounds.timeout_s
        late = [order for order in self.orders if now >= self._opened + order.ordered_s + timeout]
        for order in late:
            self._dropped(order, f"no answer within {timeout:g} s")
        return [Cancel(order) for order in late]

    # --- updates ------------------------------------------------------------------------------------------------

    def _arrived(self, event: Arrived) -> list[Instruction]:
        update = event.update
        if self._aggregating:
            return []  # its order stays open: it counts in the next round
        key = (update.client, update.round, update.part)
        order = self._orders.get(key)
        staleness = self.number - update.round
        if event.run != self._run.id:
            return [Refuse(update.client, f"it is of run {event.run[:40]!r}")]
        if order is None:
            return []  # accepted already, or never ordered: gateways report an end more than once
        if update.attempt != order.attempt or order.given_up:
            return [Refuse(update.client, f"of attempt {update.attempt}, which is outdated")]
        if problem := _problem(update, self._run):
            self._dropped(replace(order, refused=order.refused + 1), problem)
            return [Refuse(update.client, problem), *self._unfit(update.client, order.refused, problem)]
        if staleness > self._run.recipe.rounds.max_staleness:
            reason = f"{staleness} rounds late, at most {self._run.recipe.rounds.max_staleness} count"
            return [Refuse(update.client, reason), *self._dropped(order, reason)]
        del self._orders[key]
        parts = self._parts.setdefault(update.client, {})
        parts[update.part] = replace(update, share=order.share, helper=order.helper, refused=order.refused)
        self._learn(update.client)
        record = UpdateRecord(client=update.client, parts=tuple(parts[number] for number in sorted(parts)))
        return [Accept(self.number, record)]

    def _unfit(self, client: str, before: int, reason: str) -> list[Instruction]:
        """Note that an update is refused, after so many for the same order; too often in a row excludes its client."""
        patch = self._patches.get(client, Patch())
        # Parts of one client count as one: what its helpers send is not made again.
        patch = patch._replace(refused=reason, refusals=max(patch.refusals, before + 1), note=reason)
        self._patches[client] = patch
        known = self._clients.get(client)
        if known is None or known.excluded or (count := known.refused + patch.refusals) < REFUSALS:
            return []
        exclude = Exclude(self.number, client, _too_often(count, reason))
        self._clients[client] = replace(known, excluded=exclude.reason)
        return [exclude, *self._without(client, exclude.reason)]

    def _without(self, client: str, reason: str) -> list[Instruction]:
        """Await nothing more of a client that is excluded, neither its own work nor what it does for others."""
        out: list[Instruction] = [Cancel(order) for order in self.orders if client in (order.client, order.helper)]
        self._give_up_client(client, reason)
        for order in self.orders:
            if order.client == client:
                self._dropped(order, reason)
        self._offered = [order for order in self._offered if order.client != client]
        if not self._aggregating and self._parts.pop(client, None):
            out.append(Accept(self.number, UpdateRecord(client=client)))
        return out

    def _learn(self, client: str) -> None:
        """Note what an update says of its client."""
        parts = self._parts[client]
        own = parts.get(0)
        before = self._clients.get(client, ClientState(name=client))
        patch = self._patches.get(client, Patch())
        if own is not None and own.took_s > 0:
            # What a client waits for, such as a container, does not grow with its steps.
            train_s = own.took_s if own.train_s is None else min(max(0.0, own.train_s), own.took_s)
            whole = max(1.0, own.steps_whole / own.steps) / max(0.01, _length(own.share))
            epoch_s = own.took_s - train_s + train_s * whole
            known = before.epoch_s
            patch = patch._replace(
                epoch_s=epoch_s if known is None else known + SMOOTHING * (epoch_s - known), loss=own.loss
            )
        if own is not None and own.share == (0.0, 1.0):  # of a share the rest may be missing
            patch = patch._replace(samples=own.samples)
        self._patches[client] = patch

    def _follow_deadline(self) -> None:
        """Set a deadline while the round runs, where speeds were not known before."""
        if self._deadline is not None or self._run.recipe.mode not in (Mode.PARTIAL, Mode.OFFLOAD):
            return
        took = [part.took_s for parts in self._parts.values() for part in parts.values() if part.round == self.number]
        if took and 2 * len(took) >= self._record.target:
            self._deadline = self._run.recipe.rounds.deadline * median(took)

    # --- closing ------------------------------------------------------------------------------------------------

    def _limit(self) -> float | None:
        """Seconds after which the round closes with what it has; None: it has no such limit."""
        if self._deadline is None:
            return None
        factor = OFFLOAD_LIMIT if any(order.part for order in self.orders) else 1.0
        return self._deadline * (factor + GRACE) + GRACE_S

    def _open_of_cohort(self) -> set[str]:
        return {order.client for order in self.orders if order.round == self.number} | {
            order.client for order in self._offered
        }

    def _counted(self) -> list[str]:
        return sorted(client for client, parts in self._parts.items() if parts)

    def _ready(self, now: float) -> str:
        """Why the round closes; empty: it does not."""
        recipe, target = self._run.recipe, self._record.target
        if not target:
            return ""
        counted, waiting = self._counted(), self._open_of_cohort()
        if not waiting and self._offered:
            self._offered.clear()
        if len(counted) < self._least:
            why = self._why_missing() or "those chosen do not answer"
            missing = f"{self._least - len(counted)} more clients: {why}, and no other is there"
            self._waits = self._waiting_for(waiting) if waiting else missing
            return ""
        if not waiting:
            return "all clients have answered"
        limit = self._limit()
        if limit is not None and now >= self._opened + limit:
            return "deadline"
        needed = math.ceil(recipe.rounds.close_at * target) if recipe.mode is Mode.BUFFERED else target
        if len(counted) >= needed:
            done = [client for client in counted if client not in waiting]
            if recipe.mode is not Mode.BUFFERED:  # late updates of earlier rounds stand for nobody of the cohort
                done = [client for client in done if not self._is_late(client)]
            if len(done) >= needed:
                return f"{len(done)} of {target} clients have answered" if needed < target else "as many as wanted"
        self._waits = self._waiting_for(waiting)
        return ""

    def _is_late(self, client: str) -> bool:
        """Whether what counts of a client is of a round before: all its parts are of one."""
        return next(iter(self._parts[client].values())).round < self.number

    def _waiting_for(self, clients: set[str]) -> str:
        """Who is waited for, with what keeps them from beginning; those of whom that is known first."""
        reasons = {key[0]: reason for key, reason in self._reasons.items() if key in self._orders}
        explained = nsmallest(3, clients & reasons.keys())
        others = nsmallest(3 - len(explained), clients - reasons.keys()) if len(explained) < 3 else []
        named = [*(f"{client} ({reasons[client]})" for client in explained), *others]
        return f"{len(clients)} of {self._record.target} clients: {', '.join(named)}"

    def _why_missing(self) -> str:
        """Why one of the cohort does not count: one that is excluded, else the last that was given up."""
        given_up = [
            order for order in self._orders.values() if order.given_up and order.round == self.number and not order.part
        ]
        if not given_up:
            return ""
        shown = next((order for order in given_up if self._clients[order.client].excluded), given_up[-1])
        return f"{shown.client}: {self._clients[shown.client].excluded or shown.given_up}"

    def _classes(self) -> tuple[str, ...]:
        """What the model tells apart: as the run's record says, or, before there is one, as most clients' data do."""
        said = Counter(part.classes for parts in self._parts.values() if (part := next(iter(parts.values()), None)))
        said.pop((), None)
        return self._run.classes or max(said, key=lambda classes: (said[classes], classes), default=())

    def _refuse_other_classes(self, now: float) -> list[Instruction]:
        """Leave out the clients of a first round whose data have other classes than most."""
        wanted = self._classes()
        out: list[Instruction] = []
        for client in self._counted():
            found = next((part.classes for part in self._parts[client].values() if part.classes), wanted)
            if found != wanted:
                problem = other_classes(found, wanted)
                parts, key = self._parts.pop(client), (client, self.number, 0)
                before, own = max(part.refused for part in parts.values()), parts.get(0) or self._orders.get(key)
                self._orders[key] = Order(
                    client=client, round=self.number, attempt=own.attempt if own is not None else 1,
                    refused=before + 1, given_up=problem,
                )  # fmt: skip
                out += [*self._unfit(client, before, problem), Refuse(client, problem)]
                out.append(Accept(self.number, UpdateRecord(client=client)))
        return [*out, WriteRound(self.record(now))] if out else []

    def _aggregate(self, why: str, now: float) -> list[Instruction]:
        self._aggregating, self._again_at = True, None
        self._waits = "aggregation"
        self._offered.clear()
        self._record = replace(self._record, closed_by=why)
        out: list[Instruction] = []
        for order in self.orders:
            if order.part or order.client in self._parts or self._run.recipe.mode is Mode.SYNC:
                # What it would add is made up for already; it must not count a second time later.
                self._dropped(order, f"the round closed: {why}")
                out.append(Cancel(order))
        shares = tuple(share for client in self._counted() for share in self._shares(client))
        return [*out, WriteRound(self.record(now)), Aggregate(self.number, self._record.base, shares)]

    def _shares(self, client: str) -> list[Share]:
        parts = self._parts[client]
        samples = sum(part.samples for part in parts.values())
        staleness = self.number - min(part.round for part in parts.values())
        held = samples if self._run.recipe.update.dp is None else 1  # of whom nobody can tell whether they took part
        weight = held if self._secure else stale_weight(held, staleness)
        done = sum(part.steps for part in parts.values())
        share = sum(_length(part.share) for part in parts.values())
        whole = round(sum(part.steps_whole for part in parts.values()) / max(0.01, share))
        scale = (1, 1) if done >= whole else (min(whole, int(MOST_SCALED * done)), done)
        return [Share(parts[number], weight, scale) for number in sorted(parts)]

    def _too_few(self, event: TooFew, now: float) -> list[Instruction]:
        """Go on with a round of whose updates too few are left: those that are not fit count no more."""
        if not self._aggregating:
            return []
        self._aggregating = False
        self._least = max(self._least, event.needed)
        self._record = replace(self._record, closed_by="")
        out: list[Instruction] = []
        for client, reason in sorted({**event.left_out, **event.refused}.items()):
            parts = self._parts.pop(client, None)
            if not parts:
                continue
            before, refused = max(part.refused for part in parts.values()), client in event.refused
            if (own := parts.get(0)) is not None and own.round == self.number:
                # To be ordered again, where no other client can stand in, with all samples: nobody helps any more.
                self._orders[(client, self.number, 0)] = Order(
                    client=client, round=self.number, attempt=own.attempt, refused=before + refused,
                    given_up=reason[:200],
                )  # fmt: skip
            if refused:
                # The run's record first: a successor that finds the update once more has it refused as this one.
                out += self._unfit(client, before, reason[:200])
            else:
                self._patches[client] = self._patches.get(client, Patch())._replace(note=reason)
            out.append(Accept(self.number, UpdateRecord(client=client)))
        return [*out, WriteRound(self.record(now))]

    def _aggregated(self, event: Aggregated, now: float) -> list[Instruction]:
        if not self._aggregating:
            return []
        self.done = True
        counted: list[Counted] = []
        for client in self._counted():
            parts, refused = self._parts[client], event.refused.get(client, "")
            left_out = event.left_out.get(client, "")
            share = self._shares(client)[0]
            patch = self._patches.get(client, Patch())
            counts = not (refused or left_out)
            self._patches[client] = patch._replace(
                counted=counts, refused=refused or ("" if counts else patch.refused),
                refusals=0 if counts else patch.refusals + bool(refused), note=left_out,
                sent_bytes=sum(map(sent_bytes, parts.values())),
                residual=tuple(parts[number].residual for number in sorted(parts) if parts[number].residual),
                residual_round=max(part.round for part in parts.values()),
            )  # fmt: skip
            counted.append(
                Counted(
                    client=client,
                    samples=sum(part.samples for part in parts.values()),
                    weight=share.weight,
                    staleness=self.number - share.update.round,
                    took_s=round(max(part.took_s for part in parts.values()), 3),
                    loss=_mean_loss(parts.values()),
                    sent_bytes=sum(map(sent_bytes, parts.values())),
                    refused=refused or left_out,
                )
            )
        model = replace(event.model, number=self.number)
        self._record = replace(self._record, closed=True, counted=tuple(counted), model=model.digest)
        self._waits = ""
        of_all = [patch.epoch_s or self._clients[name].epoch_s or 0.0 for name, patch in self._patches.items()]
        result = Result(
            self.record(now), model, dict(self._patches), took_s=now - self._opened, all_s=max(of_all, default=0.0),
            classes=self._classes(),
        )  # fmt: skip
        return [Close(result)]

    def _changed(self, run: RunRecord, now: float) -> list[Instruction]:
        """Follow what was done to the run: by operators, by another round's close."""
        if run.state.final or run.round != self.number:
            self.done = True
            return [Cancel(order) for order in self.orders] if run.state.final else []
        self._run = run
        out: list[Instruction] = []
        included = False
        for client in run.clients:
            before = self._clients.get(client.name)
            if client.excluded and (before is None or not before.excluded):
                out += self._without(client.name, client.excluded)
            elif before is not None and before.excluded and not client.excluded:
                self._include(client.name)
                included = True
        self._clients = {client.name: client for client in run.clients}
        return [*out, WriteRound(self.record(now))] if out or included else []

    def _include(self, client: str) -> None:
        """Forget what was refused of a client that takes part again."""
        if (patch := self._patches.get(client)) is not None:
            self._patches[client] = patch._replace(refused="", refusals=0)
        for key, order in self._orders.items():
            if order.client == client and order.refused:
                self._orders[key] = replace(order, refused=0)


def _key(order: Order) -> Key:
    return (order.client, order.round, order.part)


def other_classes(found: tuple[str, ...], wanted: tuple[str, ...]) -> str:
    """Say how two lists of classes differ."""
    missing, extra = sorted(set(wanted) - set(found)), sorted(set(found) - set(wanted))
    parts = [f"without {', '.join(missing[:3])}"] if missing else []
    parts += [f"with {', '.join(extra[:3])}"] if extra else []
    return f"its data have other classes: {' and '.join(parts) or 'in another order'}"[:200]


def _problem(update: PartialUpdate, run: RunRecord) -> str:
    """Why an update cannot count, by what it says of itself."""
    if not 0 < update.samples <= MOST_SAMPLES:
        return f"{update.samples} samples"
    if run.most_samples and update.samples > run.most_samples:
        return f"{update.samples:,} samples, the data set has {run.most_samples:,}"
    if run.classes and update.classes not in ((), run.classes):
        return other_classes(update.classes, run.classes)
    if run.recipe.update.secagg != (update.coding == "masked"):
        return "it is not masked" if run.recipe.update.secagg else "it is masked"
    if not 0 < update.steps <= update.steps_whole:
        return f"{update.steps} steps of {update.steps_whole}"
    if update.loss is not None and not math.isfinite(update.loss):
        return "its loss is not finite"
    return ""


def sent_bytes(update: PartialUpdate) -> int:
    """Return the size of an update's files."""
    return sum(size for shard in update.shards if isinstance(size := shard.get("bytes"), int))


def _length(share: tuple[float, float]) -> float:
    return max(0.0, share[1] - share[0])


def _mean_loss(parts: Iterable[PartialUpdate]) -> float | None:
    known = [(part.loss, part.samples) for part in parts if part.loss is not None]
    total = sum(count for _, count in known)
    return sum(loss * count for loss, count in known) / total if total else None
