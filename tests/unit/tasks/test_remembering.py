"""Ids of finished tasks: what is remembered of them, for how long, and the answer to a request that uses one again."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import RefusedError
from appliance.model import Failure, Plan, Split, Subtask, SubtaskRecord, TaskRecord, TaskRequest, TaskState, encode
from appliance.model.plane_api import Record
from appliance.model.task_api import RetryAsk
from appliance.plane.store import Store
from appliance.tasks.conflicts import merged, stronger
from appliance.tasks.records import answered, done_text, may_trim, trimmed
from appliance.tasks.retention import TRIMMED, Kept, due
from appliance.tasks.steering import may_retry
from appliance.tasks.views import why

pytestmark = pytest.mark.anyio

DAY_NS = 86_400 * 10**9
NOW_NS = 1_800_000_000 * 10**9
PLAN = Plan(
    domain="navigation", subtasks=(Subtask(id="s1", skill="goto", robot="r1", params={"remembered": {"x": 1}}),)
)

kept_tasks = st.lists(
    st.builds(
        Kept,
        st.text("abcdef", min_size=1, max_size=4),
        st.integers(NOW_NS - 9 * DAY_NS, NOW_NS + DAY_NS),
        st.booleans(),
    ),
    unique_by=lambda each: each.key,
    max_size=40,
)


def done(**fields: Any) -> TaskRecord:
    """A task that has succeeded, with a plan that came with it."""
    record = TaskRecord(
        id="t-1",
        instruction="drive to the dock " * 20,
        state=TaskState.SUCCEEDED,
        plan=PLAN,
        handed_in=True,
        subtasks=(SubtaskRecord(subtask=PLAN.subtasks[0], result={"n": 1}),),
        updated_ns=NOW_NS,
        coordinator="gw-1",
        sequence=7,
    )
    return replace(record, **fields)


@given(kept_tasks, st.integers(0, 10), st.floats(0.0, 9.0), st.integers(0, 10))
def test_the_newest_stay_whole_then_small_and_the_oldest_are_forgotten_first(
    kept: list[Kept], keep: int, days: float, most: int
) -> None:
    """Never more than allowed of either; whatever goes is older than what stays of its kind, and `early` says why."""
    found = due(kept, now_ns=NOW_NS, keep=keep, days=days, most=most)
    by_key = {each.key: each for each in kept}
    trim, forget = set(found.trim), set(found.forget)
    assert not trim & forget
    assert not any(by_key[key].trimmed for key in trim), "nothing is trimmed twice"
    whole = [each for each in kept if not each.trimmed and each.key not in trim | forget]
    small = [each for each in kept if each.key in trim or (each.trimmed and each.key not in forget)]
    assert len(whole) == min(keep, sum(not each.trimmed for each in kept))
    assert len(small) <= most
    since = NOW_NS - int(days * DAY_NS)
    assert all(each.ended_ns >= since for each in small)
    assert found.early <= forget
    for key in forget:
        old = days == 0 or by_key[key].ended_ns < since
        assert old is (key not in found.early)
        if not old:
            assert len(small) == most
            assert all(each.ended_ns >= by_key[key].ended_ns for each in small)
    again = due(
        [*whole, *(each._replace(trimmed=True) for each in small)], now_ns=NOW_NS, keep=keep, days=days, most=most
    )
    assert (again.trim, again.forget) == ((), ()), "what was done is done"


@given(kept_tasks, st.floats(0.1, 9.0), st.floats(0.0, 9.0))
def test_time_alone_makes_nobody_forget_sooner(kept: list[Kept], days: float, later_days: float) -> None:
    """What is forgotten now is forgotten later too, and nothing newer than the days asked for while there is room."""
    now = due(kept, now_ns=NOW_NS, keep=0, days=days, most=1000)
    later = due(kept, now_ns=NOW_NS + int(later_days * DAY_NS), keep=0, days=days, most=1000)
    assert set(now.forget) <= set(later.forget)
    assert not now.early


def test_a_tombstone_is_small_and_says_what_came_of_the_task() -> None:
    """The outcome, when, the log; a failure's reason; no plan, no subtasks, no result."""
    failure = Failure(code="retries", message="x" * 5000)
    small = trimmed(done(state=TaskState.FAILED, failure=failure), "recorder-20260101T000000Z-0001.mcap")
    assert (small.state, small.plan, small.subtasks) == (TaskState.FAILED, None, ())
    assert small.failure is not None
    assert small.failure.code == "retries"
    assert len(encode(small)) < 1500
    text = "done on 2027-01-15 08:00:00 UTC (failed), details are in the log recorder-20260101T000000Z-0001.mcap"
    assert done_text(small) == text
    assert why(small).done == text
    assert why(small, "s1").done == text, "of its subtasks too: which it had is not known any more"
    assert done_text(done()) == ""
    assert "logs of that day" in done_text(trimmed(done(), ""))


async def test_a_tombstone_is_recognised_as_it_is_stored(tmp_path: Path) -> None:
    """By its field, and not by a parameter or a text that looks like it: what is looked through has the others."""
    looks_like = '"remembered":{'
    values = {
        "task/small": encode(trimmed(done(instruction=f"say {looks_like}"), "")),
        "task/whole": encode(done()),
        "task/failed": encode(done(plan=None, subtasks=(), instruction=looks_like)),
    }
    store = await Store.open(tmp_path / "s.sqlite")
    for key, value in values.items():
        await store.change(
            key, lambda _, key=key, value=value: Record(key=key, value=value, version={"a": 1}, write="w")
        )
    assert [each.key for each in await store.page("task/", leave_out=TRIMMED)] == ["task/failed", "task/whole"]
    assert len(await store.page("task/")) == 3
    await store.close()


def test_an_id_used_again_is_answered_with_what_came_of_it() -> None:
    """The same request as if nothing had been trimmed; another one with a note that nothing was begun."""
    small = trimmed(done(), "log.mcap")
    request = TaskRequest(instruction=done().instruction, id="t-1", plan=PLAN)
    assert answered(small, request) == small
    other = answered(small, replace(request, instruction="fly home"))
    assert other.state is TaskState.SUCCEEDED
    assert other.note.startswith("nothing was begun: task t-1 was another request ('drive to the dock")
    assert answered(done(), replace(request, instruction="fly home")) == done(), "of a whole record all can be seen"
    edited = trimmed(done(revised=1), "log.mcap")
    assert answered(edited, request) == edited, "what the request was is not known any more: nothing is claimed"


def test_nothing_of_a_trimmed_task_can_be_tried_again() -> None:
    """There is no plan left of a task that failed: it has to be submitted again."""
    small = trimmed(done(state=TaskState.FAILED), "log.mcap")
    with pytest.raises(RefusedError, match=r"done on .* its plan is not kept"):
        may_retry(small, RetryAsk(id="t-1", by="ann", act="o-1"))


def test_a_task_is_trimmed_only_when_nothing_is_left_to_be_done_about_it() -> None:
    """One that a partition left something of, or that has not ended, stays whole."""
    assert may_trim(done())
    assert not may_trim(done(state=TaskState.RUNNING))
    assert not may_trim(done(splits=(Split(coordinator="gw-2", sequence=1, state=TaskState.RUNNING),)))


def test_copies_trimmed_on_both_sides_of_a_partition_are_one_version() -> None:
    """No version lost; against one that is still whole that one stands, and is trimmed again later."""
    one, other = encode(trimmed(done(), "log.mcap")), encode(trimmed(done(), "log.mcap"))
    assert merged(one, other) == one
    whole = encode(done(subtasks=(replace(done().subtasks[0], state="succeeded"),)))
    assert stronger(one, whole) == whole
