"""Handing in many tasks: in order, paced by what the gateways say, none lost or handed in twice as another."""

import asyncio
import time
from collections import Counter
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import TaskRecord, TaskRequest
from appliance.submission import LEAST_AT_ONCE, MOST_AT_ONCE, TARGET_S, TRIES, Pace, submit_all

pytestmark = pytest.mark.anyio


class Fleet:
    """Takes tasks, unless an answer is prepared for one; keeps who came when, and how many were there together."""

    def __init__(self) -> None:
        self.answers: dict[str, list[SwiftbotError]] = {}
        self.came: list[str] = []
        self.at: dict[str, float] = {}
        self.under_way = self.most = 0

    async def submit_once(self, request: TaskRequest) -> TaskRecord:
        """Take one."""
        self.came.append(request.id)
        self.at[request.id] = time.monotonic()
        self.under_way += 1
        self.most = max(self.most, self.under_way)
        await asyncio.sleep(0.001)
        self.under_way -= 1
        if self.answers.get(request.id):
            raise self.answers[request.id].pop(0)
        return TaskRecord(id=request.id, instruction=request.instruction)


def requests(count: int) -> list[TaskRequest]:
    """Return so many."""
    return [TaskRequest(instruction="work", id=f"t-{number}") for number in range(count)]


async def handed_in(fleet: Fleet, count: int) -> dict[str, TaskRecord | SwiftbotError]:
    """Hand in so many; returns what came of each."""
    found = [(request.id, outcome) async for request, outcome in submit_all(cast("Any", fleet), requests(count))]
    assert len(dict(found)) == len(found)
    return dict(found)


async def test_all_are_handed_in_in_order_and_several_at_once() -> None:
    """Each once, begun in the order of the file, never more under way than may be."""
    fleet = Fleet()
    found = await handed_in(fleet, 200)
    assert fleet.came == [f"t-{number}" for number in range(200)]
    assert all(isinstance(each, TaskRecord) for each in found.values())
    assert 2 <= fleet.most <= MOST_AT_ONCE


async def test_a_gateway_that_says_when_to_come_back_is_given_that_time() -> None:
    """Nothing is handed in meanwhile, and what was sent away is the next."""
    fleet = Fleet()
    fleet.answers["t-5"] = [RefusedError("busy", retry_after_s=0.2)]
    found = await handed_in(fleet, 30)
    assert all(isinstance(each, TaskRecord) for each in found.values())
    first, again = (number for number, task in enumerate(fleet.came) if task == "t-5")
    assert again - first < 10
    assert fleet.at["t-5"] - fleet.at["t-4"] >= 0.19
    assert fleet.at["t-29"] > fleet.at["t-5"]


async def test_what_is_wrong_is_told_and_the_others_go_on() -> None:
    """A refusal without a time to come back is final; so is a task that cannot be read."""
    fleet = Fleet()
    fleet.answers = {"t-1": [RefusedError("a stop")], "t-2": [PayloadError("too long")]}
    found = await handed_in(fleet, 5)
    assert [task for task, outcome in found.items() if isinstance(outcome, SwiftbotError)] == ["t-1", "t-2"]
    assert Counter(fleet.came).most_common(1)[0][1] == 1


async def test_a_fleet_that_is_gone_ends_it() -> None:
    """After a few tries; one that is back in time is handed the task again."""
    fleet = Fleet()
    fleet.answers = {"t-1": [UnreachableError("nobody")]}
    assert len(await handed_in(fleet, 5)) == 5
    fleet.answers = {"t-1": [UnreachableError("nobody") for _ in range(TRIES)]}
    with pytest.raises(UnreachableError, match="nobody"):
        await handed_in(fleet, 50)


async def test_requests_are_read_as_they_are_needed() -> None:
    """A file of a million lines is not in memory; a consumer that stops has no more of it handed in."""
    fleet = Fleet()
    read = 0

    def lines() -> Any:
        nonlocal read
        for request in requests(10_000):
            read += 1
            yield request

    outcomes = submit_all(cast("Any", fleet), lines())
    async for _ in outcomes:
        break
    await outcomes.aclose()
    assert read <= MOST_AT_ONCE
    before = len(fleet.came)
    await asyncio.sleep(0.02)
    assert len(fleet.came) == before


@settings(deadline=None)
@given(st.lists(st.one_of(st.floats(0.0, 1.0), st.none()), max_size=200))
def test_there_are_always_some_under_way_and_never_too_many(took: list[float | None]) -> None:
    """However long submissions take and whoever is sent away, it goes on."""
    pace, now = Pace(), 100.0
    for each in took:
        now += 0.01
        if each is None:
            pace.sent_away(RefusedError("busy", retry_after_s=0.5), now)
            assert pace.at_once(now) == 0
        else:
            pace.taken(each)
        assert LEAST_AT_ONCE <= pace.at_once(now + 1000.0) <= MOST_AT_ONCE


def test_quick_answers_widen_and_slow_ones_narrow() -> None:
    """So that a submission takes about as long as it should."""
    pace = Pace()
    for _ in range(100):
        pace.taken(TARGET_S / 10)
    wide = pace.at_once(0.0)
    for _ in range(20):
        pace.taken(TARGET_S * 3)
    assert pace.at_once(0.0) < wide
