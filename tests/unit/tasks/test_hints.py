"""Plan hints: what is worked out from a plan, when it is sent again, and that it never gets in the way."""

import asyncio
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import UnreachableError
from appliance.model import Need, Plan, PoolHint, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.model.pool_api import Hinted
from appliance.tasks.durations import DEFAULT_S, WINDOW, Durations
from appliance.tasks.lookahead import AGAIN_S, HORIZON_S, MOST_AT_ONCE, MOST_KEEP_S, Hinting, expected_starts, hints

pytestmark = pytest.mark.anyio

BASE, VISION = Need(image="base"), Need(image="vision")


def task(states: dict[str, SubtaskState], after: dict[str, tuple[str, ...]], **fields: Any) -> TaskRecord:
    """Return a running task."""
    subtasks = tuple(
        SubtaskRecord(subtask=Subtask(id=name, skill="work", after=after.get(name, ())), state=state)
        for name, state in states.items()
    )
    return TaskRecord(id="t", instruction="x", **{"state": TaskState.RUNNING, "subtasks": subtasks, **fields})


W, R, S = SubtaskState.WAITING, SubtaskState.RUNNING, SubtaskState.SUCCEEDED
DIAMOND = {"s2": ("s1",), "s3": ("s1",), "s4": ("s2", "s3")}


def test_a_subtask_is_expected_when_those_before_it_should_have_ended() -> None:
    """The longest way counts, what has run already is taken off, and an overdue one may end at any moment."""
    record = task({"s1": R, "s2": W, "s3": W, "s4": W}, DIAMOND)
    seconds = {"s1": 10.0, "s2": 2.0, "s3": 5.0, "s4": 1.0}
    assert expected_starts(record, seconds, {"s1": 4.0}) == {"s2": 6.0, "s3": 6.0, "s4": 11.0}
    assert expected_starts(record, seconds, {"s1": 40.0}) == {"s2": 0.0, "s3": 0.0, "s4": 5.0}
    done = task({"s1": S, "s2": R, "s3": S, "s4": W}, DIAMOND)
    assert expected_starts(done, seconds, {"s2": 0.5}) == {"s4": 1.5}


def test_hints_count_what_runs_at_the_same_time() -> None:
    """Two in parallel are two containers, two one after the other are one; each gateway and image has its own hint."""
    record = task({"s1": R, "s2": W, "s3": W, "s4": W}, DIAMOND)
    seconds = {"s1": 10.0, "s2": 2.0, "s3": 5.0, "s4": 1.0}
    starts = expected_starts(record, seconds, {"s1": 4.0})
    places = {"s2": "gw-1", "s3": "gw-1", "s4": "gw-1"}
    found = hints(record, starts=starts, places=places, needs=dict.fromkeys(places, BASE), seconds=seconds)
    assert list(found) == [("gw-1", "base")]
    hint = found["gw-1", "base"]
    assert (hint.count, hint.in_s, hint.task, hint.need) == (2, 6.0, "t", BASE)
    assert hint.in_s + hint.keep_s >= 12.0
    needs = {"s2": BASE, "s3": VISION, "s4": BASE}
    apart = hints(record, starts=starts, places=places | {"s4": "gw-2"}, needs=needs, seconds=seconds)
    assert {key: each.count for key, each in apart.items()} == {
        ("gw-1", "base"): 1, ("gw-1", "vision"): 1, ("gw-2", "base"): 1,
    }  # fmt: skip


def test_a_task_that_is_being_cancelled_needs_nothing() -> None:
    """What was told is taken back then."""
    record = task({"s1": R, "s2": W}, {"s2": ("s1",)}, state=TaskState.CANCELLING)
    assert hints(record, starts={"s2": 1.0}, places={"s2": "gw-1"}, needs={"s2": BASE}, seconds={}) == {}


@st.composite
def plans(draw: st.DrawFn) -> TaskRecord:
    """A task with an acyclic plan in any state."""
    count = draw(st.integers(1, 8))
    names = [f"s{number}" for number in range(count)]
    after = {
        name: tuple(draw(st.lists(st.sampled_from(names[:number]), unique=True)) if number else ())
        for number, name in enumerate(names)
    }
    return task({name: draw(st.sampled_from(SubtaskState)) for name in names}, after)


@given(plans(), st.floats(0, 1000), st.floats(0, 1000), st.sampled_from(("gw-1", "gw-2", "")))
def test_hints_are_bounded_whatever_the_plan(record: TaskRecord, took: float, running: float, place: str) -> None:
    """Only waiting subtasks count, times are not negative, and what is sent can be followed."""
    names = [each.subtask.id for each in record.subtasks]
    waiting = {each.subtask.id for each in record.subtasks if each.state is SubtaskState.WAITING}
    seconds = dict.fromkeys(names, took)
    starts = expected_starts(record, seconds, dict.fromkeys(names, running))
    assert starts.keys() == waiting
    assert all(start >= 0 for start in starts.values())
    found = hints(
        record, starts=starts, places=dict.fromkeys(names, place), needs=dict.fromkeys(names, BASE), seconds=seconds
    )
    assert bool(found) == bool(place and any(start <= HORIZON_S for start in starts.values()))
    for (gateway, image), hint in found.items():
        assert (gateway, image) == (place, "base")
        assert 1 <= hint.count <= len(waiting)
        assert 0 <= hint.in_s <= HORIZON_S
        assert 0 < hint.keep_s <= MOST_KEEP_S


def test_a_circle_does_not_hang() -> None:
    """No valid plan has one; a record from elsewhere may."""
    assert expected_starts(task({"a": W, "b": W}, {"a": ("b",), "b": ("a",)}), {}, {}) == {}


class Gateways:
    """Who gets which hint; `gate` holds answers back."""

    def __init__(self) -> None:
        self.told: list[tuple[str, PoolHint]] = []
        self.now = 0.0
        self.gate: asyncio.Event | None = None
        self.problem: Exception | None = None
        self.hinting = Hinting(self.tell, clock=lambda: self.now)

    async def tell(self, gateway: str, hint: PoolHint) -> Hinted:
        """Take a hint."""
        self.told.append((gateway, hint))
        if self.gate is not None:
            await self.gate.wait()
        if self.problem is not None:
            raise self.problem
        return Hinted(taken=True)

    async def update(self, wanted: dict[tuple[str, str], PoolHint], task: str = "t") -> list[tuple[str, PoolHint]]:
        """Tell of a plan; returns what was told."""
        self.told.clear()
        self.hinting.update(task, wanted)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        return list(self.told)


KEY = ("gw-1", "base")
HINT = PoolHint(image="base", count=2, in_s=10.0, keep_s=30.0, task="t")


async def test_what_has_not_changed_is_not_told_again() -> None:
    """The same need at about the same time is one message, until it may have been met by somebody else."""
    gateways = Gateways()
    assert await gateways.update({KEY: HINT}) == [("gw-1", HINT)]
    gateways.now = 4.0
    assert await gateways.update({KEY: PoolHint(image="base", count=2, in_s=6.3, keep_s=30.0, task="t")}) == []
    sooner = PoolHint(image="base", count=2, in_s=2.0, keep_s=30.0, task="t")
    assert await gateways.update({KEY: sooner}) == [("gw-1", sooner)]
    gateways.now += AGAIN_S
    assert len(await gateways.update({KEY: sooner})) == 1


async def test_a_changed_plan_takes_back_what_it_had_told() -> None:
    """A count of 0 to the gateway that is not wanted any more; nothing when its time is over anyway."""
    gateways = Gateways()
    await gateways.update({KEY: HINT})
    moved = await gateways.update({("gw-2", "base"): HINT})
    assert moved == [("gw-1", PoolHint(image="base", count=0, task="t")), ("gw-2", HINT)]
    gateways.now = 100.0
    assert await gateways.update({}) == []
    assert not gateways.hinting._told


async def test_gateways_that_do_not_answer_hold_nothing_up() -> None:
    """Hints on their way are bounded, errors are nobody's business, and closing ends what is left."""
    gateways = Gateways()
    gateways.gate = asyncio.Event()
    many = {(f"gw-{number}", "base"): HINT for number in range(2 * MOST_AT_ONCE)}
    assert len(await gateways.update(many)) == MOST_AT_ONCE
    gateways.problem = UnreachableError("nobody there")
    gateways.gate.set()
    for _ in range(10):  # the answers are taken in
        await asyncio.sleep(0)
    assert len(await gateways.update(many)) == MOST_AT_ONCE
    gateways.hinting.close()


async def test_durations_are_the_median_of_what_was_measured(plane: Any) -> None:
    """An outlier does not count, old runs are forgotten, a restart remembers, nonsense is left out."""
    durations = Durations(plane.store)
    assert durations.of("work", {}) == DEFAULT_S
    for took in (1.0, 1.2, 60.0, 1.1, 0.9):
        durations.add("work", took)
    for wrong in (-1.0, float("nan"), 1e9):
        durations.add("work", wrong)
    assert durations.of("work", {}) == 1.1
    assert durations.of("work", {"duration_s": 20}) == 20
    assert durations.of("work", {"duration_s": "soon"}) == 1.1
    await durations.close()
    plane.store.values["duration/broken"] = b"{"
    again = Durations(plane.store)
    await again.load()
    assert again.of("work", {}) == 1.1
    assert again.of("broken", {}) == DEFAULT_S
    for _ in range(WINDOW):
        again.add("work", 5.0)
    assert again.of("work", {}) == 5.0
    await again.close()


async def test_a_driver_looks_ahead_when_subtasks_move(bench: Any) -> None:
    """Each step of the plan is announced once, and durations of what succeeded are noted."""
    plan = Plan(domain="any", subtasks=(Subtask(id="s1", skill="work"), Subtask(id="s2", skill="work", after=("s1",))))
    bench.context.the_plan = plan
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, "succeeded", duration_ms=1200.0)
    _, request = await bench.ordered()
    bench.tell(request, "succeeded", duration_ms=800.0)
    await bench.end()
    states = [states for states, _ in bench.context.moved]
    assert ("dispatched", "waiting") in states
    assert all(len(set(states)) > 1 or "waiting" in states for states in states[:-1])
    assert bench.context.took == [("work", 1200.0), ("work", 800.0)]


async def test_a_task_of_one_subtask_tells_nobody_anything(bench: Any) -> None:
    """Nothing waits, so there is nothing to look ahead to."""
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, "succeeded")
    await bench.end()
    assert bench.context.moved == []
