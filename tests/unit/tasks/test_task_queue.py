"""Whose turn it is among tasks that wait: senders take turns, orders pass floods, nobody starves, nothing is lost."""

import math
from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.pool.fair_queue import AGING_S
from appliance.tasks.queue import RESERVED, TaskQueue, Waiting

NAMES = st.sampled_from(("ann", "bob", "cas", ""))


@st.composite
def tasks(draw: st.DrawFn) -> list[Waiting]:
    """Some that wait, with whatever senders, priorities and deadlines."""
    return [
        Waiting(
            id=str(number),
            submitter=draw(NAMES),
            priority=draw(st.integers(0, 9)),
            accepted_ns=draw(st.integers(0, 5)),
            due_at=draw(st.one_of(st.just(math.inf), st.floats(0, 100))),
        )
        for number in range(draw(st.integers(0, 24)))
    ]


def waiting(task: str, submitter: str = "ann", **more: float) -> Waiting:
    """Return a plain task that waits."""
    fields = {"priority": 5, "accepted_ns": 0} | more
    return Waiting(id=task, submitter=submitter, **fields)  # pyright: ignore[reportArgumentType]


def nobody(submitter: str, priority: int) -> int:
    """Nothing is being worked on."""
    del submitter, priority
    return 0


def served(queue: TaskQueue, now: float = 0.0, most: int = 1000) -> list[Waiting]:
    """Return those that are taken up while there is room, in order."""
    found: list[Waiting] = []
    while len(found) < most and (task := queue.next(now, room=True, busy=nobody)) is not None:
        found.append(task)
    return found


@settings(deadline=None)
@given(tasks(), st.lists(st.integers(0, 24), max_size=8))
def test_each_task_that_waits_has_one_turn(all_tasks: list[Waiting], taken_out: list[int]) -> None:
    """Nothing is lost or doubled, whatever is taken out meanwhile or comes twice."""
    queue = TaskQueue()
    for task in [*all_tasks, *all_tasks]:
        queue.add(task, 0.0)
    out = {str(number) for number in taken_out if queue.remove(str(number)) is not None}
    assert len(queue) == len(all_tasks) - len(out)
    assert Counter(each.id for each in served(queue)) == Counter({each.id for each in all_tasks} - out)
    assert not len(queue)


@settings(deadline=None)
@given(tasks())
def test_tasks_of_one_sender_keep_their_order(all_tasks: list[Waiting]) -> None:
    """By priority, then deadline, then acceptance; and `ahead` tells the truth about it."""
    queue = TaskQueue()
    for task in all_tasks:
        queue.add(task, 0.0)
    ahead = {task.id: queue.ahead(task.id) for task in all_tasks}
    order = served(queue)
    for name in {task.submitter for task in all_tasks}:
        mine = [task for task in order if task.submitter == name]
        assert mine == sorted(mine, key=lambda each: (-each.priority, each.due_at, each.accepted_ns, each.id))
        assert [ahead[task.id] for task in mine] == list(range(len(mine)))


@settings(deadline=None, max_examples=20)
@given(st.integers(1, 300), st.integers(0, 200))
def test_a_flood_holds_up_no_other_sender(flood: int, before: int) -> None:
    """However many one sender has waiting and was served before, another's first is next or the one after that."""
    queue = TaskQueue()
    for number in range(flood + before):
        queue.add(waiting(f"f{number}", "flood"), 0.0)
    served(queue, most=before)
    queue.add(waiting("late", "other"), 1000.0)
    assert "late" in [task.id for task in served(queue, 1000.0, most=2)]


def test_an_order_passes_ten_thousand_of_its_own_sender() -> None:
    """Of a higher priority it is next, however long the others have waited."""
    queue = TaskQueue()
    for number in range(10_000):
        queue.add(waiting(f"f{number}", priority=4), 0.0)
    queue.add(waiting("order", priority=5), 3600.0)
    assert [task.id for task in served(queue, 3600.0, most=1)] == ["order"]


def test_a_sender_of_low_priority_is_not_passed_over_for_ever() -> None:
    """Each `AGING_S` without a turn counts as one priority more, whatever keeps coming of others."""
    queue = TaskQueue()
    queue.add(waiting("low", "low", priority=3), 0.0)
    for number in range(200):
        now = float(number)
        queue.add(waiting(f"r{number}", "rival", priority=5), now)
        task = queue.next(now, room=True, busy=nobody)
        assert task is not None
        if task.id == "low":
            assert now <= 2 * AGING_S + 1
            return
    raise AssertionError("it starved")


def test_one_that_hands_in_task_by_task_does_not_hold_up_a_flood() -> None:
    """A sender of which one waits at a time has as many turns as one with many, no more."""
    queue = TaskQueue()
    for number in range(100):
        queue.add(waiting(f"f{number}", "flood"), 0.0)
    had = Counter[str]()
    for number in range(40):
        queue.add(waiting(f"t{number}", "trickle"), 0.0)
        task = queue.next(0.0, room=True, busy=nobody)
        assert task is not None
        had[task.submitter] += 1
    assert abs(had["flood"] - had["trickle"]) <= 1


def test_without_room_only_those_go_that_have_too_few_at_work() -> None:
    """A sender whose tasks do not fill the places is not held up by another's; its next one waits like all."""
    queue = TaskQueue()
    for number in range(5):
        queue.add(waiting(f"f{number}", "flood"), 0.0)
        queue.add(waiting(f"o{number}", "other"), 0.0)
    at_work = Counter({"flood": 200})

    def busy(submitter: str, priority: int) -> int:
        del priority
        return at_work[submitter]

    for _ in range(RESERVED):
        task = queue.next(0.0, room=False, busy=busy)
        assert task is not None
        assert task.submitter == "other"
        at_work["other"] += 1
    assert queue.next(0.0, room=False, busy=busy) is None
    assert queue.next(0.0, room=True, busy=busy) is not None


def test_turns_of_one_sender_can_be_kept_apart() -> None:
    """Each sender has its first turn at once, and its next one after the pause."""
    queue = TaskQueue()
    for number in range(3):
        queue.add(waiting(f"a{number}", "ann"), 0.0)
        queue.add(waiting(f"b{number}", "bob"), 0.0)

    def turn(now: float) -> str:
        task = queue.next(now, room=True, busy=nobody, apart_s=0.1)
        return "" if task is None else task.submitter

    assert {turn(0.0), turn(0.0)} == {"ann", "bob"}
    assert [turn(0.05), turn(0.1), turn(0.1), turn(0.15)].count("") == 2


def test_turns_are_kept_apart_also_of_a_sender_of_which_one_waits_at_a_time() -> None:
    """What comes while the last one has just had its turn waits for the pause, however short the line is."""
    queue, had = TaskQueue(), 0
    for number in range(100):
        now = 0.01 * number
        queue.add(waiting(f"t{number}"), now)
        had += queue.next(now, room=True, busy=nobody, apart_s=0.25) is not None
    assert had == 4


def test_a_task_whose_deadline_passes_is_taken_out() -> None:
    """Its coordinator has to end it; one that was taken out already is not given again."""
    queue = TaskQueue()
    for number in range(3):
        queue.add(waiting(f"t{number}", due_at=10.0 * number), 0.0)
    queue.remove("t0")
    assert [task.id for task in queue.overdue(15.0)] == ["t1"]
    assert queue.overdue(15.0) == []
    assert list(queue) == ["t2"]
