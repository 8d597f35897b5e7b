"""Which gateway takes a run: warm, idle, near, trusted; never one that cannot; and not all the same one."""

from collections import Counter
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import ContainerInfo, ContainerState, GatewayStatus, Need
from appliance.model.task_api import Weighed
from appliance.tasks.migration.policy import History, Place, closest
from appliance.tasks.settings import MigrationConfig

NEED = Need(image="base")
CONFIG = MigrationConfig()


def place(name: str, *, warm: bool = True, near: float = 0.0, **fields: Any) -> Place:
    """A gateway."""
    info = ContainerInfo(id="c", gateway=name, image="base", state=ContainerState.READY)
    status = GatewayStatus(**{"id": name, "fleet": "f", "capacity": 4} | fields)
    return Place(status=status, containers=(info,) if warm else (), near=near)


def weigh(*places: Place, run: str = "t/s/1", history: History | None = None, **more: Any) -> list[Weighed]:
    """Weigh them for a run on gw-0."""
    named = {each.status.id: each for each in places}
    return closest(
        NEED, run, named, **{"source": "gw-0", "config": CONFIG, "history": history or History(), "tried": {}} | more
    )


def test_each_of_the_criteria_decides_where_the_others_are_equal() -> None:
    """A warm container, idle processors and containers, the data, earlier moves."""
    for better, worse in (
        (place("b"), place("a", warm=False)),
        (place("b"), place("a", running=3)),
        (place("b", cpu_percent=5), place("a", cpu_percent=70)),
        (place("b", near=1.0), place("a")),
    ):
        assert weigh(better, worse)[0].gateway == "b"
    history = History()
    for _ in range(8):
        history.went("a", well=False)
    spread = Counter(weigh(place("a"), place("b"), run=f"r{n}", history=history)[0].gateway for n in range(9))
    assert spread == {"b": 9}


def test_who_cannot_take_it_is_named_with_the_reason() -> None:
    """Where it is, draining, overloaded, no room, tried, not allowed, not the one wanted."""
    found = {
        each.gateway: each.verdict
        for each in weigh(
            place("gw-0"),
            place("gw-1", draining=True),
            place("gw-2", overloaded="3 runs wait"),
            place("gw-3", warm=False, queue=2),
            place("gw-4", warm=False, pool_problem="no Podman"),
            place("gw-5"),
            place("gw-6", cpu_percent=90.0),
            place("gw-7"),
            tried={"gw-5": "it had none"},
            may=frozenset({"gw-7", "gw-5"}),
        )
    }
    assert found.pop("gw-7") == ""
    assert all(found.values()), found
    assert weigh(place("gw-1"), place("gw-2"), to="gw-2")[0].gateway == "gw-2"
    assert weigh(place("gw-1", cpu_percent=99.0), lenient=True)[0].verdict == ""


def test_many_runs_find_many_gateways() -> None:
    """Ten equal ones share a hundred runs: nobody gets more than a few times its part."""
    places = [place(f"g{number}") for number in range(10)]
    taken = Counter(weigh(*places, run=f"t/s{number}/1")[0].gateway for number in range(100))
    assert len(taken) == 10
    assert max(taken.values()) < 30


@settings(deadline=None)
@given(
    st.lists(
        st.builds(
            place,
            st.sampled_from([f"g{number}" for number in range(6)]),
            warm=st.booleans(),
            near=st.floats(0, 1),
            running=st.integers(0, 5),
            queue=st.integers(0, 3),
            draining=st.booleans(),
            overloaded=st.sampled_from(["", "busy"]),
        ),
        max_size=6,
    )
)
def test_candidates_come_first_and_none_is_unable(places: list[Place]) -> None:
    """Whatever is there: each gateway once, able ones before the others, all scores between 0 and 1."""
    found = weigh(*places)
    assert len({each.gateway for each in found}) == len(found)
    verdicts = [bool(each.verdict) for each in found]
    assert verdicts == sorted(verdicts)
    assert all(0.0 <= each.score <= 1.0 for each in found)
    named = {each.status.id: each for each in places}
    for each in found:
        if not each.verdict:
            assert not named[each.gateway].status.draining
            assert not named[each.gateway].status.overloaded
