"""Rounds in virtual time, with real training: the product's decider and handlers, clocks that are counted.

The simulator plays the decider; what it orders is trained by the handlers in containers, as many at a time as there are
containers, with the steps that the device would make by then. Times are those of devices whose batch takes
`NOMINAL_BATCH_S` times their speed, and nothing else takes any time: what messages, sums and starts cost is measured on
fleets (`live`). All follows from the seed, however busy this machine is.

`decide` plays the same rounds without training, for their times alone.
"""

import asyncio
import math
from collections.abc import Callable, Coroutine, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from statistics import median
from threading import Event as Flag
from typing import Any, NamedTuple, TypeVar

import anyio
import anyio.to_thread
from msgspec.structs import replace

from appliance.errors import PoolError
from appliance.learn import recipe as recipes
from appliance.learn import rounds
from appliance.learn.round_driver import LEFT_OUT, base_of, data_of, part_of
from appliance.learn.rounds import Event, Key
from appliance.model.learning import (
    Clients,
    Data,
    Evaluation,
    Mode,
    Model,
    Order,
    PartialUpdate,
    Recipe,
    Rounds,
    Update,
)
from appliance.skills._lib.learning import models, shards
from appliance.skills._lib.learning.seeds import seed as derive
from workshop.bench.figures import summary
from workshop.bench.learning.cells import NOMINAL_BATCH_S, client_name, speeds
from workshop.bench.learning.hostile import Attack, spoiled
from workshop.bench.training import Trainer
from workshop.simulators.learning import Device, Outcome, Simulation

T = TypeVar("T")
BY = "dirichlet:0.5"
DROP = "drop"
RULES = {"mean": "mean", "trimmed": "trimmed:0.25", "multikrum": "multikrum:4"}


class Sample(NamedTuple):
    """How good a model is: `own` is its accuracy on the data that stragglers hold."""

    round: int
    at_s: float
    accuracy: float
    loss: float
    own: float | None


def recipe_of(
    workload: str, mode: str, *, clients: int, count: int, data: str, seed: int, rule: str = "mean"
) -> Recipe:
    """Return the recipe of a measurement; mode `drop` is `buffered` that takes no late update."""
    shared = mode == Mode.OFFLOAD
    given = Rounds(
        count=count,
        mode=Mode.BUFFERED if mode == DROP else Mode(mode),
        max_staleness=0 if mode == DROP else 5,
    )
    return Recipe(
        model=workload,
        seed=seed,
        data=Data(name=data, share="fleet" if shared else "never"),
        clients=Clients(partitions=clients, by=BY),
        rounds=given,
        update=Update(rule=RULES[rule]),
        evaluation=Evaluation(every=0),
    )


class Emulated(Simulation):
    """Rounds of devices that make steps, without training.

    Args:
        recipe: of the run.
        samples: of each client, in the order of the recipe's names.
        slow: client -> how many times slower than nominal it is.
        batch: samples of a step.
        nominal_batch_s: what a step takes a nominal device.
    """

    def __init__(
        self,
        recipe: Recipe,
        samples: Sequence[int],
        slow: Mapping[str, float],
        batch: int,
        *,
        nominal_batch_s: float = NOMINAL_BATCH_S,
    ) -> None:
        self._recipe = recipe
        self._batch_s = {name: nominal_batch_s * slow.get(name, 1.0) for name in recipe.names}
        self._batch = batch
        devices = {
            name: Device(steps_of(held, batch) * self._batch_s[name], held)
            for name, held in zip(recipe.names, samples, strict=True)
        }
        super().__init__(recipe, devices)

    def _work(self, order: Order) -> tuple[float, PartialUpdate]:
        owner, batch_s = self._devices[order.client], self._batch_s[order.helper or order.client]
        indices = part_of(self._recipe, order, samples=owner.samples).get("indices")
        samples = owner.samples if indices is None else len(indices)
        whole = steps_of(samples, self._batch)
        done = whole if order.stop_at_s is None else steps_by(order.stop_at_s, batch_s, whole)
        took = done * batch_s
        if order.stop_at_s is not None and done < whole:
            took = order.stop_at_s  # the wait for the last step ends then
        update = PartialUpdate(
            client=order.client, round=order.round, part=order.part, attempt=order.attempt, gateway="gw",
            samples=samples, steps=done, steps_whole=whole, loss=1.0, took_s=took,
        )  # fmt: skip
        return took, update


def steps_of(samples: int, batch: int) -> int:
    """Return the steps of an epoch."""
    return max(1, -(-samples // batch))


def steps_by(stop_at_s: float, batch_s: float, whole: int) -> int:
    """Return the steps that a device begins before it is to stop: at least one, at most the whole epoch."""
    return max(1, min(whole, math.ceil(stop_at_s / batch_s - 1e-9)))


class Trained(Emulated):
    """The same with training: what is ordered is trained in containers while virtual time goes on.

    Played on a thread; the trainer's event loop does the work.
    """

    def __init__(
        self,
        recipe: Recipe,
        samples: Sequence[int],
        slow: Mapping[str, float],
        batch: int,
        *,
        trainer: Trainer,
        at_once: int,
        every: int,
        attacks: Mapping[str, Attack],
        progress: Callable[[str], None],
    ) -> None:
        self._trainer = trainer
        self._attacks = attacks
        self._slow = slow
        self._every = every
        self._progress = progress
        self._room = asyncio.Semaphore(at_once)
        self._loop = asyncio.get_running_loop()
        self._training: dict[tuple[Key, int], Future[dict[str, Any]]] = {}
        self._judging: list[Future[Sample]] = []
        self._files: dict[int, list[str]] = {}
        """Round -> files of its updates: they are forgotten when they cannot count any more."""
        self.refused: dict[str, str] = {}
        """Client -> why an update of it was refused last."""
        self.refusals = 0
        self.ended = Flag()
        """Set where the measurement is given up: the thread then ends."""
        super().__init__(recipe, samples, slow, batch)

    # --- on the simulator's thread

    def _later(self, work: Coroutine[Any, Any, T]) -> "Future[T]":
        if self.ended.is_set():
            work.close()
            raise PoolError("the measurement was given up")
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def _work(self, order: Order) -> tuple[float, PartialUpdate]:
        took, update = super()._work(order)
        key = ((order.client, order.round, order.part), order.attempt)
        base = next((model for model in self._run.models if model.number == order.round - 1), Model())
        self._training[key] = self._later(self._train(order, base, update))
        return took, update

    def _delivered(self, event: Event) -> Event:
        if not isinstance(event, rounds.Arrived):
            return event
        update = event.update
        training = self._training.pop(((update.client, update.round, update.part), update.attempt), None)
        if training is None or training.cancelled():
            return event  # told again, or cancelled: the decider awaits it no more
        found = training.result()
        if (found["samples"], found["steps"], found["steps_of_epoch"]) != (
            update.samples,
            update.steps,
            update.steps_whole,
        ):
            raise PoolError(f"{update.client} trained {found['steps']} steps, the device makes {update.steps}")
        if (attack := self._attacks.get(update.client)) is not None:
            drawn = derive(self._recipe.seed, update.round, update.client, "attack")
            found = found | spoiled(found, attack, self._trainer.files, seed=drawn)
        self._files.setdefault(update.round, []).extend(each["artifact"] for each in found["shards"])
        whole = replace(update, manifest=found["manifest"], shards=tuple(found["shards"]), loss=found["loss"])
        return rounds.Arrived(event.run, whole)

    def _cancelled(self, order: Order) -> None:
        found = self._training.get(((order.client, order.round, order.part), order.attempt))
        if found is not None:
            found.cancel()

    def _made(self, aggregate: rounds.Aggregate) -> Event:
        made = self._later(self._aggregated(aggregate)).result()
        refused: dict[str, str] = {}
        left_out: dict[str, str] = {}
        for client, verdict in made["verdicts"].items():
            if not verdict["accepted"]:
                listed = left_out if verdict["reason"] in LEFT_OUT else refused
                listed[client] = f"{verdict['reason']}: {verdict['message']}"
        self.refused |= refused
        self.refusals += len(refused)
        model = Model(
            number=aggregate.number, digest=shards.parse_manifest(made["manifest"]).digest, manifest=made["manifest"],
            shards=tuple(made["shards"]),
        )  # fmt: skip
        return rounds.Aggregated(model, refused, left_out)

    def _has_closed(self, result: rounds.Result) -> None:
        number = result.record.number
        for old in [each for each in self._files if each < number - self._recipe.rounds.max_staleness - 1]:
            for digest in self._files.pop(old):
                self._trainer.files.pop(digest, None)
        if number % self._every == 0 or number == self._recipe.rounds.count:
            self._judging.append(self._later(self._judged(result.model, self._now)))
        if number % 10 == 0:
            self._progress(f"round {number} of {self._recipe.rounds.count}")

    # --- on the event loop

    async def _train(self, order: Order, base: Model, update: PartialUpdate) -> dict[str, Any]:
        part = part_of(self._recipe, order, samples=self._devices[order.client].samples)
        async with self._room:
            found, _ = await self._trainer.run(
                "train_local", run="bench", round=order.round, client=order.client, attempt=order.attempt,
                model=self._recipe.model, base=base_of(base), data=data_of(self._recipe), part=part,
                seed=self._recipe.seed, most_steps=update.steps,
            )  # fmt: skip
        return found

    async def _aggregated(self, aggregate: rounds.Aggregate) -> dict[str, Any]:
        updates = [
            {
                "client": share.update.client,
                "manifest": share.update.manifest,
                "shards": list(share.update.shards),
                "weight": share.weight,
                "scale": 1 if share.scale[0] == share.scale[1] else {"num": share.scale[0], "den": share.scale[1]},
            }
            for share in aggregate.shares
        ]
        made, _ = await self._trainer.run(
            "aggregate", run="bench", round=aggregate.number, model=self._recipe.model,
            base=base_of(aggregate.base), updates=updates, rule=recipes.rule_of(self._recipe.update.rule),
            seed=self._recipe.seed,
        )  # fmt: skip
        return made

    async def _judged(self, model: Model, at_s: float) -> Sample:
        shared: dict[str, Any] = {
            "model": self._recipe.model, "base": base_of(model), "data": data_of(self._recipe),
            "seed": self._recipe.seed,
        }  # fmt: skip
        async with self._room:
            whole, _ = await self._trainer.run("evaluate", **shared)
        right = total = 0
        for name in sorted(self._slow):
            part = {"by": BY, "index": self._recipe.names.index(name), "of": len(self._recipe.names)}
            async with self._room:
                own, _ = await self._trainer.run("evaluate", **shared, part=part, split="train")
            right, total = right + own["right"], total + own["total"]
        self._progress(f"after round {model.number}: accuracy {whole['accuracy']:.4f} of {whole['items']:,} items")
        return Sample(
            model.number, round(at_s, 3), round(whole["accuracy"], 5), round(whole["loss"], 5),
            round(right / total, 5) if total else None,
        )  # fmt: skip

    async def samples(self) -> list[Sample]:
        """Return how good the models were, in order."""
        return sorted([await asyncio.wrap_future(each) for each in self._judging])


def decide(
    workload: str, mode: str, *, clients: int, count: int, held: Sequence[int], stragglers: bool
) -> dict[str, Any]:
    """Return the times of rounds of emulated devices, without training: `round_s`, `p50`, `later_p50`."""
    recipe = recipe_of(workload, mode, clients=clients, count=count, data=workload, seed=1)
    slow = speeds(clients, stragglers=stragglers)
    found = Emulated(recipe, held, slow, models.read(workload).batch).play()
    return {"mode": mode, "clients": clients, "slow": slow, **_times(found)}


def _times(found: Outcome) -> dict[str, Any]:
    took = [round(each, 3) for each in found.took_s]
    # In the first round nothing is known of clients' speeds.
    return {
        "round_s": summary([each * 1e3 for each in took]),
        "p50_s": round(median(took[1:] or took), 4),
        "took_s": took,
        "first_s": took[0],
        "whole_s": round(sum(took), 3),
        "late": found.late,
        "offloaded": found.offloaded,
        "counted": {name: found.counted[name] for name in sorted(found.counted)},
    }


async def train(
    trainer: Trainer,
    *,
    workload: str,
    mode: str,
    clients: int,
    count: int,
    every: int,
    seed: int,
    data: Path,
    held: Sequence[int],
    at_once: int,
    rule: str = "mean",
    attacks: Mapping[str, Attack] | None = None,
    stragglers: bool = True,
    progress: Callable[[str], None],
) -> dict[str, Any]:
    """Train a model in virtual time.

    Args:
        trainer: containers that train.
        workload: the model.
        mode: a mode of recipes, or `drop`.
        clients: of the cohort.
        count: rounds.
        every: rounds between two evaluations.
        seed: of the run.
        data: folder of the data set.
        held: samples of each client.
        at_once: runs at the same time.
        rule: how updates become one.
        attacks: clients that send what they should not.
        stragglers: whether some clients are slow.
        progress: told how far it is.

    Returns:
        `curve`: round, seconds of virtual time, accuracy, loss, accuracy on stragglers' own data; times of rounds as
        `decide` returns them; `refusals`, and by client the last `refused`.

    Raises:
        PoolError: a run failed.
    """
    recipe = recipe_of(workload, mode, clients=clients, count=count, data=data.name, seed=seed, rule=rule)
    slow = speeds(clients, stragglers=stragglers)
    simulation = Trained(
        recipe, held, slow, models.read(workload).batch, trainer=trainer, at_once=at_once, every=every,
        attacks=attacks or {}, progress=progress,
    )  # fmt: skip
    try:
        found = await anyio.to_thread.run_sync(simulation.play, abandon_on_cancel=True)
        curve = await simulation.samples()
    finally:
        simulation.ended.set()
    return {
        "mode": mode,
        "seed": seed,
        "slow": {client_name(number): slow[client_name(number)] for number in range(len(slow))},
        "curve": [each._asdict() for each in curve],
        "refusals": simulation.refusals,
        "refused": simulation.refused,
        "excluded": {each.name: each.excluded for each in found.run.clients if each.excluded},
        **_times(found),
    }
