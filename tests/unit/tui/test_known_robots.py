"""Robots with all that is known around them, followed by what changes."""

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import (
    Enquiry,
    GatewayStatus,
    Lease,
    Lifted,
    RobotInfo,
    SoftStop,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.tui.robot_view import KnownRobots, Robot, leases_of, missions, questions_of
from appliance.tui.store import Gateway, Store

NAMES = ("r1", "r2", "r3")
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("robot"), st.sampled_from(NAMES), st.sampled_from(["", "AUTO", "gone"])),
        st.tuples(st.just("task"), st.sampled_from(["t1", "t2"]), st.sampled_from([*NAMES, "done", "gone"])),
        st.tuples(st.just("lease"), st.sampled_from(NAMES), st.sampled_from(["ann", "bob", "gone"])),
        st.tuples(st.just("ask"), st.sampled_from(NAMES), st.sampled_from(["open", "answered", "gone"])),
        st.tuples(st.just("stop"), st.sampled_from([*NAMES, ""]), st.sampled_from(["ann", "lift"])),
        st.tuples(st.just("look"), st.just(""), st.just("")),
        st.tuples(st.just("forget"), st.just(""), st.just("")),
    ),
    max_size=40,
)


def do(store: Store, number: int, what: str, name: str, how: str) -> None:
    """Change something of a fleet."""
    if what == "robot" and how == "gone":
        store.robots.drop(name)
    elif what == "robot":
        store.robots.put(name, RobotInfo(id=name, kind="zenoh", mode=how))
    elif what == "task" and how == "gone":
        store.forget_task(name)
    elif what == "task":
        state = TaskState.SUCCEEDED if how == "done" else TaskState.RUNNING
        step = Subtask(id="s1", skill="goto", robot="r1" if how == "done" else how)
        record = SubtaskRecord(subtask=step, state=SubtaskState.RUNNING, progress=number / 100)
        store.tasks.put(name, TaskRecord(id=name, instruction="x", state=state, subtasks=(record,)))
    elif what == "lease":
        leases = () if how == "gone" else (Lease(id=f"l{number}", robot=name, by=how, at_ns=number),)
        store.gateways.put("gw", Gateway(status=GatewayStatus(id="gw", fleet="f", leases=leases)))
    elif what == "ask" and how == "gone":
        store.enquiries.drop(f"q-{name}")
    elif what == "ask":
        answer = "yes" if how == "answered" else None
        store.enquiries.put(f"q-{name}", Enquiry(id=f"q-{name}", question="?", robot=name, answer=answer))
    elif what == "stop" and how == "lift":
        store.take_stops((), (Lifted(id=f"u{number}", stops=store.stops.to_lift([name] if name else [])),))
    elif what == "stop":
        store.take_stops((SoftStop(id=f"o{number}", robots=(name,) if name else (), by=how),))
    elif what == "forget":
        store.forget_all()


def counted(store: Store) -> dict[str, Robot]:
    """Return the robots made again from all that there is; without missions, of which a robot may have several."""
    leases = leases_of(store.gateways.values())
    questions = questions_of(store.enquiries.values())
    found: dict[str, Robot] = {}
    for name in sorted(store.robots):
        stop = store.stops.of(name)
        found[name] = Robot(
            info=store.robots[name], stopped=stop.text if stop is not None else "", lease=leases.get(name),
            questions=questions.get(name, ()),
        )  # fmt: skip
    return found


@settings(deadline=None)
@given(steps=STEPS)
def test_what_is_followed_is_what_there_is(steps: list[tuple[str, str, str]]) -> None:
    """However robots, tasks, leases, questions and stops come and go, the rows are those made again from everything."""
    store, known = Store(tasks=5, entries=5), KnownRobots()
    for number, (what, name, how) in enumerate(steps):
        if what != "look":
            do(store, number, what, name, how)
            continue
        rows = known.of(store)
        assert list(rows) == sorted(rows)
        plain = {name: Robot(info=each.info, stopped=each.stopped, lease=each.lease, questions=each.questions)
                 for name, each in rows.items()}  # fmt: skip
        assert plain == counted(store)
        for robot, each in rows.items():
            may = {found[robot] for record in store.tasks.values() if robot in (found := missions(record))}
            assert each.mission in may or (not may and not each.mission)


def test_one_that_is_as_it_was_is_the_same_thing() -> None:
    """Nothing is made again for what has not changed, nor for a change that a robot's row does not tell."""
    store, known = Store(), KnownRobots()
    for name in NAMES:
        store.robots.put(name, RobotInfo(id=name, kind="zenoh"))
    before = dict(known.of(store))
    store.robots.put("r2", RobotInfo(id="r2", kind="zenoh", mode="AUTO"))
    store.gateways.put("gw", Gateway(status=GatewayStatus(id="gw", fleet="f", load=0.5)))
    after = known.of(store)
    assert [after[name] is before[name] for name in NAMES] == [True, False, True]


def test_another_store_is_begun_anew() -> None:
    """When a recorded log is shown instead of the fleet, nothing of the fleet is left in the rows."""
    first, second, known = Store(), Store(), KnownRobots()
    first.robots.put("r1", RobotInfo(id="r1", kind="zenoh"))
    assert list(known.of(first)) == ["r1"]
    second.robots.put("r2", RobotInfo(id="r2", kind="zenoh"))
    assert list(known.of(second)) == ["r2"]
    assert list(known.of(first)) == ["r1"]


def test_a_robot_that_waits_says_for_whom() -> None:
    """The row of a robot has what its subtask waits for beside what it does."""
    subtask = Subtask(id="s1", skill="goto", robot="r1")
    noted = {"waits for r2 to leave dock 1": " waits for r2 to leave dock 1", "going to dock 1: 30 m": ""}
    for note, shown in noted.items():
        record = TaskRecord(
            id="t1",
            instruction="",
            state=TaskState.RUNNING,
            subtasks=(SubtaskRecord(subtask=subtask, state=SubtaskState.RUNNING, note=note),),
        )
        assert missions(record) == {"r1": f"t1/s1 goto{shown}"}
