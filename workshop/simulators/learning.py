"""Federated learning in virtual time: the product's own decider over thousands of clients, with faults, checked.

No model is trained: a client takes the time that its speed says and sends an update without values (`bench.learning`
trains for real, by what it puts in the place of `_work`, `_delivered`, `_made` and `_has_closed`). What is checked
after every step are the promises of `learn.rounds`: each order's update counts once at most, each round makes one
model, a round closes or says what it waits for and does not look again for nothing, and nothing of another run, round
or attempt counts. A breach raises `InvariantError` with what was done.
"""

import heapq
import math
import random
from collections import Counter
from collections.abc import Callable, Mapping
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from appliance.learn import rounds
from appliance.learn.rounds import Decider, Event, Instruction, Key
from appliance.learn.secagg import threshold
from appliance.model.learning import (
    ClientState,
    Cohort,
    Model,
    Order,
    PartialUpdate,
    PublicKeys,
    Recipe,
    RoundRecord,
    RunRecord,
    RunState,
    UpdateRecord,
)

MOST_IDLE = 8
"""Times that a decider may look again in a row and want nothing: each of the times that it waits for may come once."""


class InvariantError(AssertionError):
    """A promise of the decider does not hold."""


class Device(NamedTuple):
    """A client: what an epoch takes it, and its samples."""

    epoch_s: float
    samples: int = 96


class Faults(Struct, frozen=True, kw_only=True):
    """How often what goes wrong, each a probability."""

    fails: float = 0.0
    """An attempt ends without an update."""
    transient: float = 0.0
    """An attempt fails for what passes by itself."""
    silent: float = 0.0
    """An attempt never ends."""
    leaves: float = 0.0
    """A client goes when it is ordered something, and is back after some epochs."""
    repeated: float = 0.0
    """An update is sent twice, and once more in the next round."""
    foreign: float = 0.0
    """An update comes that is of another run, or that was not ordered."""
    takeover: float = 0.0
    """The coordinator goes before an event, and another one goes on from the records."""
    refused: float = 0.0
    """An update is refused where it is summed."""
    lost: float = 0.0
    """The files of an update are gone when it is summed."""
    aggregation: float = 0.0
    """Aggregating fails."""


class Outcome(NamedTuple):
    """What came of a simulated run. `took_s`: of each round; `counted`: rounds in which a client's update counted."""

    run: RunRecord
    took_s: tuple[float, ...]
    all_s: tuple[float, ...]
    counted: Counter[str]
    late: int
    """Updates that counted in a later round than their own."""
    offloaded: int
    """Parts that others trained."""
    orders: int
    takeovers: int


class Simulation:
    """One run. `play` plays it to its end.

    Args:
        recipe: of the run; its clients' names are those of `devices`.
        devices: the clients.
        faults: what goes wrong.
        seed_number: of the faults and their times.
        late_devices: clients that are not there at first -> when they come, seconds.
        decider: makes the deciders, with arguments as of `Decider`.
    """

    def __init__(
        self,
        recipe: Recipe,
        devices: Mapping[str, Device],
        *,
        faults: Faults | None = None,
        seed_number: int = 0,
        late_devices: Mapping[str, float] | None = None,
        decider: Callable[..., Decider] = Decider,
    ) -> None:
        self._make = decider
        self._devices = devices
        self._faults = faults or Faults()
        self._chance = random.Random(seed_number)  # noqa: S311 - no secret
        self._now = 0.0
        self._queue: list[tuple[float, int, Event]] = []
        self._sequence = 0
        late = late_devices or {}
        self._present = {name: "gw" for name in devices if name not in late}
        for name, at in late.items():
            self._push(at, rounds.Present(name, "gw"))
        clients = tuple(ClientState(name=name) for name in devices)
        self._run = RunRecord(id="simulated", recipe=recipe, clients=clients)
        self._round = RoundRecord(run="simulated", number=1)
        self._updates: dict[str, UpdateRecord] = {}
        self._ended: dict[tuple[Key, int], tuple[float, Event]] = {}
        """Order and attempt -> when it ends, and what its gateway tells of its end from then on."""
        self._begun: set[tuple[Key, int]] = set()
        self._accepted: set[Key] = set()
        self._models = self._epochs = 0
        self._idle = 0
        """How often in a row the decider looked again and wanted nothing."""
        self._took: list[float] = []
        self._all: list[float] = []
        self._counted: Counter[str] = Counter()
        self._late = self._offloaded = self._orders = self._takeovers = 0
        self._decider = self._begin()

    def play(self, *, most_events: int = 50_000_000) -> Outcome:
        """Play until the run has ended."""
        self._carry_out(self._decider.resume(self._now))
        for _ in range(most_events):
            if self._run.state.final:
                break
            self._step()
        else:
            raise InvariantError(f"round {self._run.round} is not over after {most_events:,} events")
        self._check_end()
        return Outcome(
            self._run, tuple(self._took), tuple(self._all), self._counted, self._late, self._offloaded, self._orders,
            self._takeovers,
        )  # fmt: skip

    def _begin(self) -> Decider:
        return self._make(self._run, self._round, updates=self._updates.values(), present=self._present, now=self._now)

    def _push(self, at: float, event: Event) -> None:
        self._sequence += 1
        heapq.heappush(self._queue, (at, self._sequence, event))

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and self._chance.random() < probability

    def _step(self) -> None:
        """Take the next event, or look again when the decider wants to."""
        at = self._decider.next_at(self._now)
        if self._queue and (at is None or self._queue[0][0] <= at):
            self._now, _, event = heapq.heappop(self._queue)
            self._idle = 0
            event = self._delivered(event)
            self._note(event)
            if self._happens(self._faults.takeover):
                self._take_over()
            self._carry_out(self._decider.handle(event, self._now))
        elif at is not None:
            self._now = at
            wanted = self._decider.advance(self._now)
            self._idle = 0 if wanted else self._idle + 1
            if self._idle > MOST_IDLE:
                raise InvariantError(f"round {self._run.round} looks again for nothing: {self._decider.waits!r}")
            self._carry_out(wanted)
        else:
            raise InvariantError(f"round {self._run.round} waits for ever: {self._decider.waits!r}")
        if not self._run.state.final and not self._decider.done and not (self._decider.waits or self._decider.orders):
            raise InvariantError(f"round {self._run.round} waits for nothing and does not close")

    def _note(self, event: Event) -> None:
        match event:
            case rounds.Present():
                self._present[event.client] = event.gateway
            case rounds.Lost():
                self._present.pop(event.client, None)
            case _:
                pass

    def _take_over(self) -> None:
        """Another coordinator goes on, with what was written."""
        self._takeovers += 1
        self._decider = self._begin()
        self._carry_out(self._decider.resume(self._now))

    # --- carrying out ---------------------------------------------------------------------------------------------

    def _carry_out(self, instructions: list[Instruction]) -> None:
        for instruction in instructions:
            match instruction:
                case rounds.WriteRound():
                    self._round = instruction.record
                case rounds.MakeKeys():
                    self._make_keys(instruction)
                case rounds.Send():
                    self._send(instruction.order)
                case rounds.Ask():
                    self._asked(instruction.order)
                case rounds.Accept():
                    self._accept(instruction)
                case rounds.Aggregate():
                    self._aggregate(instruction)
                case rounds.Close():
                    self._close(instruction.result)
                case rounds.Cancel():
                    self._cancelled(instruction.order)
                case rounds.Exclude():
                    self._exclude(instruction)
                case rounds.Refuse():
                    pass

    def _make_keys(self, make: rounds.MakeKeys) -> None:
        if self._happens(self._faults.transient):
            self._push(self._now, rounds.Unkeyed("a gateway does not answer"))
            return
        self._epochs += 1
        keyed = [client for client in make.clients if not self._happens(self._faults.lost)] or list(make.clients)
        keys = (PublicKeys(client=client, gateway="gw", sharing="", masking="") for client in keyed)
        self._push(self._now, rounds.Keyed(Cohort(epoch=str(self._epochs), clients=tuple(keys))))

    def _send(self, order: Order) -> None:
        if self._run.recipe.update.secagg and order.client not in self._masked():
            raise InvariantError(f"{order.client} is to train without masks")
        run = ((order.client, order.round, order.part), order.attempt)
        if run in self._begun:
            return  # the same order again is the same run
        self._begun.add(run)
        self._orders += 1
        self._offloaded += bool(order.part)
        doer = order.helper or order.client
        self._push(self._now, rounds.Ordered(run[0], order.attempt, "gw"))
        took, update = self._work(order)
        if doer in self._present and self._happens(self._faults.leaves):
            away = self._chance.uniform(0.1, 3.0) * self._devices[doer].epoch_s
            leaves = self._now + self._chance.uniform(0.0, took)
            self._push(leaves, rounds.Lost(doer))
            self._push(leaves + away, rounds.Present(doer, "gw"))
        if self._happens(self._faults.silent):
            return
        if self._happens(self._faults.transient):
            event: Event = rounds.Failed(run[0], order.attempt, "it was restarted", transient=True)
            took *= self._chance.random()
        elif self._happens(self._faults.fails):
            event = rounds.Failed(run[0], order.attempt, "it failed")
            took *= self._chance.random()
        else:
            event = rounds.Arrived(self._run.id, update)
        self._ended[run] = (self._now + took, event)
        self._push(self._now + took, event)
        if self._happens(self._faults.repeated):
            self._push(self._now + took, event)
            self._push(self._now + took * 2.5, event)
        if self._happens(self._faults.foreign):
            self._push(self._now + took, rounds.Arrived("another", update))
            self._push(self._now, rounds.Arrived(self._run.id, replace(update, client=f"{order.client}-x")))
            self._push(self._now, rounds.Arrived(self._run.id, replace(update, attempt=order.attempt + 7)))

    def _work(self, order: Order) -> tuple[float, PartialUpdate]:
        """What an order takes, and the update it ends with."""
        owner, doer = self._devices[order.client], self._devices[order.helper or order.client]
        samples = max(1, round(owner.samples * (order.share[1] - order.share[0])))
        steps = math.ceil(samples / 16)
        whole_s = doer.epoch_s * samples / doer.samples
        done = steps
        if order.stop_at_s is not None and whole_s > order.stop_at_s:
            done = max(1, int(steps * order.stop_at_s / whole_s))
        took = whole_s * done / steps
        update = PartialUpdate(
            client=order.client,
            round=order.round,
            part=order.part,
            attempt=order.attempt,
            gateway="gw",
            samples=samples,
            steps=done,
            steps_whole=steps,
            loss=1.0,
            took_s=took,
            coding="masked" if self._run.recipe.update.secagg else "none",
        )
        return took, update

    def _asked(self, order: Order) -> None:
        run = ((order.client, order.round, order.part), order.attempt)
        if run in self._ended:
            at, event = self._ended[run]
            if at <= self._now:
                self._push(self._now, event)
        elif run not in self._begun:
            self._push(self._now, rounds.Failed(run[0], order.attempt, "the gateway has no record of it"))

    def _accept(self, accept: rounds.Accept) -> None:
        if accept.number != self._run.round:
            raise InvariantError(f"an update is accepted for round {accept.number} in round {self._run.round}")
        before = self._updates.get(accept.record.client)
        known = {(part.client, part.round, part.part) for part in before.parts} if before is not None else set[Key]()
        for part in accept.record.parts:
            key = (part.client, part.round, part.part)
            if key in known:
                continue
            if key in self._accepted:
                raise InvariantError(f"{key} is accepted twice")
            if (key, part.attempt) not in self._begun:
                raise InvariantError(f"{key} was never ordered")
            if self._run.round - part.round > self._run.recipe.rounds.max_staleness:
                raise InvariantError(f"{key} counts in round {self._run.round}")
            self._accepted.add(key)
            self._late += part.round < self._run.round
        gone = known - {(part.client, part.round, part.part) for part in accept.record.parts}
        self._accepted -= gone
        if len({part.round for part in accept.record.parts}) > 1:
            raise InvariantError(f"{accept.record.client} counts with two rounds' work")
        self._updates[accept.record.client] = accept.record

    def _exclude(self, exclude: rounds.Exclude) -> None:
        after = rounds.excluded(self._run, exclude, now_ns=0)
        if after is None:
            raise InvariantError(f"{exclude.client} is excluded twice, or in another round: {exclude.number}")
        self._run = after

    def _aggregate(self, aggregate: rounds.Aggregate) -> None:
        if aggregate.number != self._run.round or aggregate.number != self._models + 1:
            raise InvariantError(f"round {aggregate.number} is aggregated in round {self._run.round}")
        found = Counter((share.update.client, share.update.part) for share in aggregate.shares)
        if any(count > 1 for count in found.values()):
            raise InvariantError(f"a client counts twice in round {aggregate.number}")
        summed = {(share.update.client, share.update.round, share.update.part) for share in aggregate.shares}
        accepted = {(part.client, part.round, part.part) for each in self._updates.values() for part in each.parts}
        if not summed <= accepted:
            raise InvariantError(f"round {aggregate.number} sums what was not accepted")
        if self._run.recipe.update.secagg:
            self._check_cohort({share.update.client for share in aggregate.shares})
        if any(share.weight < 1 or share.scale[0] < 1 or share.scale[1] < 1 for share in aggregate.shares):
            raise InvariantError(f"round {aggregate.number} has a weight or scale of nothing")
        if self._happens(self._faults.aggregation):
            self._push(self._now, rounds.AggregateFailed("it failed"))
            return
        self._push(self._now, self._made(aggregate))

    def _masked(self) -> set[str]:
        """The clients that have masks."""
        cohort = self._round.cohort
        return {each.client for each in cohort.clients} if cohort is not None else set[str]()

    def _check_cohort(self, summed: set[str]) -> None:
        """Masks cancel among the clients of one cohort, of which a majority answers."""
        clients = self._masked()
        if not summed <= clients or len(summed) < threshold(len(clients)):
            raise InvariantError(f"{len(summed)} of a cohort of {len(clients)} are summed, or others")

    # --- what those put in the place of who train

    def _delivered(self, event: Event) -> Event:
        """Return an event as it is handed to the decider."""
        return event

    def _cancelled(self, order: Order) -> None:
        """An order's run is ended; what it does after that counts for nothing."""

    def _made(self, aggregate: rounds.Aggregate) -> Event:
        """Return what comes of an aggregation."""
        clients = {share.update.client for share in aggregate.shares}
        refused = {client: "nan" for client in sorted(clients) if self._happens(self._faults.refused)}
        lost = {client: "lost" for client in sorted(clients - refused.keys()) if self._happens(self._faults.lost)}
        if len(refused) + len(lost) == len(clients):
            return rounds.TooFew(1, refused, lost)
        return rounds.Aggregated(Model(digest=f"model-{aggregate.number}"), refused, lost)

    def _has_closed(self, result: rounds.Result) -> None:
        """A round was closed; the run's record says so."""

    def _close(self, result: rounds.Result) -> None:
        after = rounds.closed(self._run, result, now_ns=0)
        if after is None:
            raise InvariantError(f"round {result.record.number} closes twice")
        self._models += 1
        if after.model.number != self._models or result.record.number != self._models:
            raise InvariantError(f"round {result.record.number} made model {after.model.number}")
        self._counted.update(each.client for each in result.record.counted if not each.refused)
        self._took.append(result.took_s)
        self._all.append(result.all_s)
        self._run = after
        self._has_closed(result)
        if after.state.final:
            return
        self._round = rounds.opened(result)
        self._updates = {}
        self._decider = self._begin()
        self._carry_out(self._decider.resume(self._now))

    def _check_end(self) -> None:
        if self._run.state is RunState.SUCCEEDED and self._models != self._run.recipe.rounds.count:
            raise InvariantError(f"{self._models} models of {self._run.recipe.rounds.count} rounds")
