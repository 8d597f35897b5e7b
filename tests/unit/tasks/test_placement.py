"""Coarse scheduling: which gateway, and which robot behind `any`."""

from collections.abc import Sequence
from itertools import permutations
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import ContainerInfo, ContainerState, GatewayStatus, Need, RobotInfo, Subtask, SubtaskRecord
from appliance.tasks.placement import bind as bind_all
from appliance.tasks.placement import candidates, place
from appliance.tasks.settings import TasksConfig

NEED = Need(image="base")


def status(name: str, **fields: object) -> GatewayStatus:
    """Return a gateway's status."""
    return GatewayStatus(id=name, fleet="f", **fields)  # type: ignore[arg-type]


def container(gateway: str, state: ContainerState = ContainerState.READY, image: str = "base") -> ContainerInfo:
    """Return a container."""
    return ContainerInfo(id=f"{gateway}-c", gateway=gateway, image=image, state=state)


def order(
    gateways: list[GatewayStatus], *, warm: tuple[str, ...] = (), here: str = "gw-1", **fields: object
) -> tuple[str, ...]:
    """Place a subtask and return the order."""
    arguments: dict[str, object] = {"holds": {}, "robot": None, "avoid": frozenset(), **fields}
    return place(
        NEED,
        here=here,
        gateways={each.id: each for each in gateways},
        containers={name: {f"{name}-c": container(name)} for name in warm},
        config=TasksConfig(),
        **arguments,  # type: ignore[arg-type]
    ).order


def test_warm_and_idle_gateways_come_first() -> None:
    """A ready container outweighs a little load, and equal gateways go to the one that asks."""
    gateways = [status("gw-1", load=0.1), status("gw-2", load=0.3), status("gw-3", load=0.1)]
    assert order(gateways, warm=("gw-2",))[0] == "gw-2"
    assert order(gateways, here="gw-3")[0] == "gw-3"


def test_draining_and_broken_gateways_are_no_candidates() -> None:
    """A draining gateway is never chosen; one without Podman only while it has warm containers."""
    gateways = [status("gw-1", draining=True), status("gw-2", pool_problem="Podman does not answer")]
    assert order(gateways) == ()
    assert order(gateways, warm=("gw-1", "gw-2")) == ("gw-2",)


def test_gateways_where_it_failed_come_last() -> None:
    """A retry goes elsewhere while there is an elsewhere."""
    gateways = [status("gw-1"), status("gw-2", load=0.9)]
    assert order(gateways, warm=("gw-1",), avoid=frozenset({"gw-1"})) == ("gw-2", "gw-1")


def test_what_was_said_long_ago_counts_less() -> None:
    """A gateway that is silent beyond its promise loses its lead bit by bit, and the reason says so."""
    gateways = [status("gw-1", load=0.3), status("gw-2", load=0.0)]
    assert order(gateways, warm=("gw-2",))[0] == "gw-2"
    assert order(gateways, warm=("gw-2",), stale_s={"gw-2": 0.2})[0] == "gw-2"
    assert order(gateways, warm=("gw-2",), stale_s={"gw-2": 60.0})[0] == "gw-1"
    busy = [status("gw-1", load=0.6), status("gw-2", load=1.0)]
    assert order(busy)[0] == "gw-1"
    assert order(busy, stale_s={"gw-2": 60.0})[0] == "gw-2"
    found = place(
        NEED, here="gw-1", gateways={each.id: each for each in gateways}, containers={}, holds={}, robot=None,
        avoid=frozenset(), config=TasksConfig(), stale_s={"gw-2": 4.0},
    )  # fmt: skip
    assert "gw-2 0." in found.why
    assert "(silent for 4 s too long)" in found.why


def test_work_goes_to_its_robots_link_and_to_its_data() -> None:
    """Without input files the robot's gateway is near; with them, the gateway that holds them."""
    gateways = [status("gw-1"), status("gw-2"), status("gw-3")]
    robot = RobotInfo(id="drone_1", kind="mavlink", gateway="gw-2")
    assert order(gateways, robot=robot)[0] == "gw-2"
    assert order(gateways, robot=robot, holds={"gw-3": 1.0})[0] == "gw-3"


@given(
    st.dictionaries(
        st.sampled_from(["a", "b", "c", "d"]),
        st.tuples(st.floats(-1, 2), st.booleans(), st.booleans(), st.booleans()),
        min_size=1,
    )
)
def test_every_able_gateway_is_in_the_order_once(fleet: dict[str, tuple[float, bool, bool, bool]]) -> None:
    """No able gateway is forgotten, none that is not is named, whatever the loads."""
    gateways = [
        status(name, load=load, draining=drains, pool_problem="x" if broken else "")
        for name, (load, drains, broken, _) in fleet.items()
    ]
    warm = tuple(name for name, row in fleet.items() if row[3])
    able = {name for name, (_, drains, broken, has) in fleet.items() if not drains and (has or not broken)}
    found = order(gateways, warm=warm)
    assert set(found) == able
    assert len(found) == len(able)


ROVER = RobotInfo(id="rover_1", kind="zenoh", uses=("base", "arm", "camera"), verbs=("goto", "pick", "capture"))
DRONE = RobotInfo(id="drone_1", kind="mavlink", uses=("base",), verbs=("goto", "takeoff"), flies=True)
ROBOTS = {each.id: each for each in (ROVER, DRONE)}


def bind(label: str, these: Sequence[SubtaskRecord], **how: Any) -> tuple[str | None, str]:
    """Return the robot of a label, or None and the reason for the wait."""
    found, reason = bind_all((label,), lambda each: candidates(each, these, **how))
    return next(iter(found), None), reason


def records(*subtasks: Subtask) -> tuple[SubtaskRecord, ...]:
    """Wrap subtasks."""
    return tuple(SubtaskRecord(subtask=each) for each in subtasks)


def test_any_is_a_robot_that_can_do_all_that_its_label_must() -> None:
    """`any` that goes somewhere and picks needs one robot with base and arm for both."""
    these = records(Subtask(id="s1", skill="goto", robot="any"), Subtask(id="s2", skill="pick", robot="any"))
    uses = {"s1": ("base",), "s2": ("arm",)}
    verbs = {"s1": ("goto",), "s2": ("pick",)}
    assert bind("any", these, robots=ROBOTS, uses=uses, verbs=verbs, busy=frozenset()) == ("rover_1", "")


def test_any_prefers_a_robot_that_is_free() -> None:
    """Of two that can, the idle one."""
    these = records(Subtask(id="s1", skill="goto", robot="any"))
    found = bind(
        "any", these, robots=ROBOTS, uses={"s1": ("base",)}, verbs={"s1": ("goto",)}, busy=frozenset({"drone_1"})
    )
    assert found == ("rover_1", "")


def test_a_robot_that_keeps_failing_at_it_is_chosen_last() -> None:
    """Experience counts for more than a robot that is busy, and for less than that nobody else can do it."""
    these = records(Subtask(id="s1", skill="goto", robot="any"))
    none: dict[str, tuple[str, ...]] = {"s1": ()}

    def chosen(busy: frozenset[str], *shunned: str) -> str | None:
        return bind(
            "any",
            these,
            robots=ROBOTS,
            uses=none,
            verbs=none,
            busy=busy,
            shuns=lambda _subtask, robot: "it failed" if robot in shunned else "",
        )[0]

    first = chosen(frozenset())
    assert first is not None
    other = chosen(frozenset(), first)
    assert other not in (None, first)
    assert chosen(frozenset(set(ROBOTS) - {first}), first) != first
    assert chosen(frozenset(), *ROBOTS) == first


def test_two_labels_are_two_robots() -> None:
    """`any1` and `any2` do not become the same robot while another can."""
    first = SubtaskRecord(subtask=Subtask(id="s1", skill="goto", robot="any1"), bound_robot="drone_1")
    second = SubtaskRecord(subtask=Subtask(id="s2", skill="goto", robot="any2"))
    arguments = {"uses": {"s1": ("base",), "s2": ("base",)}, "verbs": {}, "busy": frozenset[str]()}
    assert bind("any2", (first, second), robots=ROBOTS, **arguments) == ("rover_1", "")  # type: ignore[arg-type]
    assert bind("any1", (first, second), robots=ROBOTS, **arguments) == ("drone_1", "")  # type: ignore[arg-type]


def test_an_absent_robot_is_waited_for_by_name() -> None:
    """The reason for the wait names the robot."""
    these = records(Subtask(id="s1", skill="goto", robot="rover_9"))
    robot, reason = bind("rover_9", these, robots=ROBOTS, uses={}, verbs={}, busy=frozenset())
    assert robot is None
    assert "rover_9" in reason


def test_a_robot_called_anymal_is_a_named_robot() -> None:
    """Only `any`, `any1`, ... are labels; what merely begins so is a name, and is waited for by name."""
    records = [SubtaskRecord(subtask=Subtask(id="s1", skill="goto", robot="anymal_1"))]
    dog, other = RobotInfo(id="anymal_1", kind="zenoh"), RobotInfo(id="aaa", kind="zenoh")
    roster = {"aaa": other, "anymal_1": dog}
    assert bind("anymal_1", records, robots=roster, uses={}, verbs={}, busy=frozenset()) == ("anymal_1", "")
    chosen, why = bind("anymal_1", records, robots={"aaa": other}, uses={}, verbs={}, busy=frozenset())
    assert chosen is None
    assert "anymal_1" in why


def test_a_bound_robot_that_went_offline_is_waited_for() -> None:
    """A label means one robot throughout: while that one is away its subtasks wait, and say for whom."""
    records = [
        SubtaskRecord(subtask=Subtask(id="s1", skill="goto", robot="any"), bound_robot="rover_1"),
        SubtaskRecord(subtask=Subtask(id="s2", skill="goto", robot="any")),
    ]
    away = RobotInfo(id="rover_1", kind="zenoh", online=False)
    chosen, why = bind("any", records, robots={"rover_1": away}, uses={}, verbs={}, busy=frozenset())
    assert chosen is None
    assert why == "waits for rover_1: offline"
    holding = replace(away, holding="red box")
    at_ns = 1_700_000_000_000_000_000
    for roster, held in (({"rover_1": holding}, ", while it held the red box"), ({"rover_1": away}, ""), ({}, "")):
        _, why = bind("any", records, robots=roster, uses={}, verbs={}, busy=frozenset(), lost_ns={"rover_1": at_ns})
        assert why == f"waits for robot rover_1, lost since 22:13:20 UTC{held}", "also when its row has gone"


def joint(*robots: str, bound: tuple[str, ...] = ()) -> SubtaskRecord:
    """Return a subtask that several robots do together."""
    subtask = Subtask(id="s9", skill="rendezvous", robot=robots[0], params={"robots": [*robots]})
    return SubtaskRecord(subtask=subtask, bound_robot=next(iter(bound), None), others=bound[1:])


def test_robots_of_a_joint_subtask_are_bound_all_or_none() -> None:
    """While one of them is away, stopped or not there, none is bound, and the reason names that one."""
    how: dict[str, Any] = {"uses": {"s9": ("base",)}, "verbs": {"s9": ("goto",)}, "busy": frozenset()}
    these = (joint("rover_1", "drone_1"),)

    def both(robots: dict[str, RobotInfo] = ROBOTS, **more: Any) -> tuple[tuple[str, ...], str]:
        return bind_all(these[0].subtask.robots, lambda each: candidates(each, these, robots=robots, **how, **more))

    assert both() == (("rover_1", "drone_1"), "")
    assert both(ROBOTS | {"drone_1": replace(DRONE, online=False)}) == ((), "waits for drone_1: offline")
    assert both({"rover_1": ROVER}) == ((), "waits for drone_1: not in the roster")
    stopped = both(hindrance=lambda robot: "stopped by ann" if robot == "drone_1" else "")
    assert stopped == ((), "waits for drone_1: stopped by ann")


def test_a_label_of_a_joint_subtask_is_the_same_robot_before_and_after() -> None:
    """Also where it is not the first of its robots."""
    before = SubtaskRecord(subtask=Subtask(id="s1", skill="goto", robot="any2"), bound_robot="rover_1")
    how: dict[str, Any] = {"robots": ROBOTS, "uses": {}, "verbs": {}, "busy": frozenset[str]()}
    these = (before, joint("any1", "any2"))
    assert bind_all(("any1", "any2"), lambda each: candidates(each, these, **how)) == (("drone_1", "rover_1"), "")
    later = SubtaskRecord(subtask=Subtask(id="s1", skill="goto", robot="any2"))
    assert bind("any2", (joint("any1", "any2", bound=("drone_1", "rover_1")), later), **how) == ("rover_1", "")


@given(
    st.dictionaries(st.sampled_from(["any", "any1", "any2", "any3"]), st.lists(st.sampled_from("abcd"), unique=True))
)
def test_joint_robots_are_different_ones_and_found_where_there_are_any(fits: dict[str, list[str]]) -> None:
    """Each label has a robot that may be it, none has two labels, and it waits only where that cannot be."""
    labels = tuple(fits)
    found, reason = bind_all(labels, lambda label: (fits[label], "" if fits[label] else "waits"))
    possible = any(
        all(robot in fits[label] for label, robot in zip(labels, robots, strict=True))
        for robots in permutations("abcd", len(labels))
    )
    assert bool(reason) is not possible
    assert len(set(found)) == len(found) == (len(labels) if possible else 0)
    assert all(robot in fits[label] for label, robot in zip(labels, found, strict=False))
