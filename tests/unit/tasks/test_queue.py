"""Ready subtasks wait for room at their coordinator: in turns, never more than there is room for, and not for ever."""

import math
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import GatewayStatus, Plan, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.tasks.placement import Line, Place


def task(name: str, **fields: Any) -> TaskRecord:
    """Return a running task of one ready subtask."""
    subtask = Subtask(id="s1", skill="work")
    record = SubtaskRecord(subtask=subtask, state=SubtaskState.READY)
    return TaskRecord(
        id=name, instruction="x", state=TaskState.RUNNING, plan=Plan(domain="any", subtasks=(subtask,)),
        subtasks=(record,), **fields,
    )  # fmt: skip


class Fleet:
    """Gateways with a capacity each, a line before them, and what was sent where."""

    def __init__(self, **capacities: int) -> None:
        self.gateways = {
            name.replace("_", "-"): GatewayStatus(id=name, fleet="f", capacity=capacity)
            for name, capacity in capacities.items()
        }
        self.woken: list[str] = []
        self.line = Line(lambda: self.gateways, backlog=0.0, wake=self.woken.append)
        self.sent: dict[str, str] = {}
        self.now = 0.0

    def ask(self, record: TaskRecord, *candidates: str, left_s: float = math.inf) -> Place:
        """Ask for a task's subtask, and send it if it may go."""
        found = self.line.ask(record, record.subtasks[0], candidates or tuple(self.gateways), self.now, left_s=left_s)
        if found.gateway:
            self.sent[record.id] = found.gateway
            self.note(record, SubtaskState.DISPATCHED)
        return found

    def note(self, record: TaskRecord, state: SubtaskState) -> None:
        """Have the line hear how a task's subtask stands."""
        target = replace(record.subtasks[0], state=state, gateway=self.sent.get(record.id, ""))
        self.line.moved(replace(record, subtasks=(target,)), self.now)

    def end(self, record: TaskRecord) -> None:
        """A task's subtask has ended."""
        self.note(record, SubtaskState.SUCCEEDED)


def test_with_room_it_goes_to_the_best_that_has_some() -> None:
    """The first candidate with room, without a wait; the next one when that is full; then the line."""
    fleet = Fleet(gw_1=1, gw_2=1)
    assert fleet.ask(task("a")).gateway == "gw-1"
    assert fleet.ask(task("b")).gateway == "gw-2"
    assert fleet.ask(task("c")) == Place(position=1, waiting=1)


def test_what_a_gateway_tells_to_run_counts_as_well() -> None:
    """Other coordinators' runs take room too; a gateway that does not tell its capacity is asked."""
    fleet = Fleet(gw_1=2, gw_2=0)
    fleet.gateways["gw-1"] = replace(fleet.gateways["gw-1"], running=2)
    assert fleet.ask(task("a"), "gw-1").position == 1
    assert fleet.ask(task("b"), "gw-2").gateway == "gw-2"


def test_turns_are_by_priority_then_deadline_then_fair() -> None:
    """Each that ends lets the next in: the urgent one, the one with a deadline, then submitters by turns."""
    fleet = Fleet(gw_1=1)
    first = task("first")
    fleet.ask(first)
    waiting = [
        task("flood-1", submitter="flood"), task("flood-2", submitter="flood"), task("other", submitter="other"),
        task("due", submitter="flood"), task("urgent", submitter="flood", priority=9),
    ]  # fmt: skip
    for each in waiting:
        fleet.ask(each, left_s=30.0 if each.id == "due" else math.inf)
    assert fleet.line.place_of(("urgent", "s1"), 0.0).position == 1
    by_id = {each.id: each for each in waiting}
    ended, order = first, list[str]()
    for _ in waiting:
        fleet.end(ended)
        order.append(fleet.woken[-1])
        ended = by_id[order[-1]]
        assert fleet.ask(ended).gateway == "gw-1"
    assert order[:2] == ["urgent", "due"]
    assert order.index("other") < order.index("flood-2")


def test_a_task_that_ends_or_is_taken_over_leaves_no_trace() -> None:
    """Its places, given and waited for, are the others'."""
    fleet = Fleet(gw_1=1)
    first, second, third = task("a"), task("b"), task("c")
    fleet.ask(first)
    fleet.ask(second)
    fleet.ask(third)
    fleet.line.forget("b", 0.0)
    fleet.line.forget("a", 0.0)
    assert fleet.woken == ["c"]
    assert fleet.ask(third).gateway == "gw-1"
    fleet.line.forget("c", 0.0)
    assert len(fleet.line) == 0
    assert fleet.ask(task("d")).gateway == "gw-1"


def test_one_that_waits_is_told_when_it_may_go() -> None:
    """From the mean of what has ended, its place, and how many run at once; nothing before anything was measured."""
    fleet = Fleet(gw_1=2)
    for name in "ab":
        fleet.ask(task(name))
    assert fleet.ask(task("c")).expected_s is None
    fleet.line.completions.ended(4.0)
    assert fleet.ask(task("c")).expected_s == 2.0
    assert fleet.ask(task("d")).expected_s == 4.0


@settings(deadline=None)
@given(
    st.integers(1, 3),
    st.integers(1, 3),
    st.lists(st.tuples(st.sampled_from("aebcd"), st.integers(0, 9), st.booleans()), min_size=1, max_size=30),
)
def test_never_more_than_there_is_room_for_and_all_go_in_the_end(
    one: int, two: int, wanted: list[tuple[str, int, bool]]
) -> None:
    """Whatever is asked, a gateway holds at most its capacity, and as runs end everybody gets a place once."""
    fleet = Fleet(gw_1=one, gw_2=two)
    records = [
        task(f"t{number}", submitter=submitter, priority=priority)
        for number, (submitter, priority, _) in enumerate(wanted)
    ]
    candidates = {
        record.id: ("gw-1",) if narrow else ("gw-1", "gw-2")
        for record, (_, _, narrow) in zip(records, wanted, strict=True)
    }
    running: list[TaskRecord] = []
    left = list(records)
    for step in range(10 * len(records) + 10):
        fleet.now = float(step)
        for record in list(left):
            if fleet.ask(record, *candidates[record.id]).gateway:
                left.remove(record)
                running.append(record)
        for name, capacity in (("gw-1", one), ("gw-2", two)):
            assert sum(fleet.sent[each.id] == name for each in running) <= capacity
        if not left:
            break
        fleet.end(running.pop(0))
    assert not left
    assert len(fleet.line) == 0
