"""Dynamic groups: small, capable, with one root that all name alike, and calm."""

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import Group
from appliance.plane.ring import Ring
from appliance.tasks.placement import HYSTERESIS, Standing, Weights, form, must_form, root_of, score, without

WEIGHTS = Weights()
NAMES = tuple(f"gw-{number}" for number in range(1, 21))
SUBTASKS = ("s1", "s2", "s3")


@st.composite
def fleets(draw: st.DrawFn) -> dict[str, Standing]:
    """Some gateways with whatever loads, data, containers and abilities."""
    names = draw(st.sets(st.sampled_from(NAMES), min_size=1))
    return {
        name: Standing(
            gateway=name,
            load=draw(st.floats(0, 1)),
            near=draw(st.floats(0, 1)),
            warm=draw(st.sampled_from((0.0, 0.5, 1.0))),
            serves=frozenset(draw(st.sets(st.sampled_from(SUBTASKS)))),
        )
        for name in sorted(names)
    }


def formed(
    fleet: dict[str, Standing], *, root: str = "", previous: Group | None = None, limit: int = 8, why: str = "formed"
) -> Group:
    """Form a group of a fleet; by default its first gateway is the root."""
    return form(fleet.values(), root=root or min(fleet), previous=previous, limit=limit, weights=WEIGHTS, why=why)


def served(fleet: dict[str, Standing], group: Group) -> frozenset[str]:
    """What a group can serve together."""
    return frozenset[str]().union(*(fleet[each].serves for each in group.members if each in fleet))


@settings(deadline=None)
@given(fleets(), st.integers(1, 8), st.integers(0, 2**32))
def test_a_group_is_small_capable_and_computed_alike(fleet: dict[str, Standing], limit: int, seed: int) -> None:
    """At most `limit`, no one twice, all but the root can serve something; the order of the facts does not matter."""
    group = formed(fleet, limit=limit)
    assert 1 <= len(group.members) <= limit
    assert len(set(group.members)) == len(group.members)
    assert group.root in group.members
    assert all(fleet[each].serves for each in group.members if each != group.root)
    names = list(fleet)
    random.Random(seed).shuffle(names)  # noqa: S311 - an order, no secret
    assert formed({name: fleet[name] for name in names}, root=group.root, limit=limit) == group


@settings(deadline=None)
@given(fleets())
def test_a_group_serves_all_that_anybody_can(fleet: dict[str, Standing]) -> None:
    """With three subtasks and room for eight, nothing is left out that some gateway could do."""
    assert served(fleet, formed(fleet)) == frozenset[str]().union(*(each.serves for each in fleet.values()))


@settings(deadline=None)
@given(st.sets(st.sampled_from(NAMES), min_size=2), st.text("abcdef0123456789", min_size=1, max_size=12))
def test_every_gateway_names_the_same_root_and_its_successor_follows(names: set[str], task: str) -> None:
    """Rings made of the same members in any order agree on the key's owner; when it goes, on who is next."""
    key = f"task/{task}"
    rings = [Ring(frozenset(order), virtual_nodes=32) for order in (sorted(names), sorted(names, reverse=True))]
    orders = {ring.successors(key, len(names)) for ring in rings}
    assert len(orders) == 1
    order = orders.pop()
    root = root_of(names, order)
    assert root == rings[0].owner(key)
    left = names - {root}
    assert root_of(left, order) == Ring(frozenset(left), virtual_nodes=32).owner(key)


@settings(deadline=None)
@given(fleets(), st.data())
def test_a_group_is_kept_while_loads_change_a_little(fleet: dict[str, Standing], data: st.DataObject) -> None:
    """Loads that go up and down by less than the hysteresis allows change nothing, however often it is looked at."""
    group = formed(fleet)
    most = 0.45 * HYSTERESIS / WEIGHTS.load
    for _ in range(3):
        moved = {
            name: replace(each, load=min(1.0, max(0.0, each.load + data.draw(st.floats(-most, most)))))
            for name, each in fleet.items()
        }
        assert formed(moved, previous=group, why="others suit better") is group
        assert not must_form(group, moved, root=group.root, ready=())


@settings(deadline=None)
@given(fleets())
def test_forming_again_changes_nothing(fleet: dict[str, Standing]) -> None:
    """What was just formed stays: there is no other group that it would turn into next."""
    group = formed(fleet)
    assert formed(fleet, previous=group) is group


@settings(deadline=None)
@given(fleets(), st.data())
def test_a_member_that_goes_is_replaced_and_the_others_stay(fleet: dict[str, Standing], data: st.DataObject) -> None:
    """The rest is kept, there is no gap while somebody could fill it, and what anybody can serve is served."""
    group = formed(fleet)
    gone = data.draw(st.sampled_from(group.members))
    left = {name: each for name, each in fleet.items() if name != gone}
    if not left:
        return
    root = group.root if group.root != gone else min(left)
    assert must_form(group, left, root=root, ready=())
    again = formed(left, root=root, previous=group)
    assert gone not in again.members
    assert again.number == group.number + 1
    able = [name for name, each in left.items() if each.serves or name == root]
    assert len(again.members) == min(8, len(able))
    assert served(left, again) == frozenset[str]().union(*(each.serves for each in left.values()))


def test_a_clearly_better_gateway_takes_the_place_of_the_worst() -> None:
    """Better by more than the hysteresis, and only if the group can do the same without the one that leaves."""
    fleet = {name: Standing(gateway=name, load=0.5, serves=frozenset({"s1"})) for name in ("gw-1", "gw-2", "gw-3")}
    group = formed({name: fleet[name] for name in ("gw-1", "gw-2")}, limit=2)
    fleet["gw-3"] = replace(fleet["gw-3"], load=0.0, warm=1.0)
    assert set(formed(fleet, previous=group, limit=2).members) == {"gw-1", "gw-3"}
    fleet["gw-2"] = replace(fleet["gw-2"], serves=frozenset({"s1", "s2"}))
    assert formed(fleet, previous=group, limit=2) is group


def test_why_a_group_must_be_formed_is_told() -> None:
    """No group, a lost member, one that can do nothing any more, a new root, a subtask that nobody in it can serve."""
    able = Standing(gateway="gw-1", serves=frozenset({"s1"}))
    fleet = {"gw-1": able, "gw-2": replace(able, gateway="gw-2")}
    group = formed(fleet)
    assert must_form(None, fleet, root="gw-1", ready=()) == "formed"
    assert must_form(group, {"gw-1": able}, root="gw-1", ready=()) == "gw-2 is gone"
    drains = fleet | {"gw-2": Standing(gateway="gw-2", why_not="is draining")}
    assert must_form(group, drains, root="gw-1", ready=()) == "gw-2 is draining"
    assert must_form(group, fleet, root="gw-2", ready=()) == "gw-2 took over from gw-1"
    other = fleet | {"gw-3": Standing(gateway="gw-3", serves=frozenset({"s2"}))}
    assert "gw-3 can" in must_form(group, other, root="gw-1", ready=("s2",))
    assert must_form(group, other, root="gw-1", ready=("s1", "s9")) == ""


def test_a_root_that_can_serve_nothing_coordinates_only() -> None:
    """It is a member all the same, and the reason says so."""
    fleet = {
        "gw-1": Standing(gateway="gw-1", why_not="is draining"),
        "gw-2": Standing(gateway="gw-2", serves=frozenset({"s1"})),
    }
    group = formed(fleet, root="gw-1")
    assert set(group.members) == {"gw-1", "gw-2"}
    assert "gw-1 coordinates only: is draining" in group.why


def test_without_a_member_the_next_on_the_ring_leads() -> None:
    """The root that goes is followed by the member that comes next; one that was no member changes nothing."""
    group = Group(members=("gw-3", "gw-1", "gw-2"), root="gw-1", why="x")
    order = ("gw-1", "gw-9", "gw-2", "gw-3")
    assert without(group, "gw-9", order) is group
    assert without(group, "gw-1", order).root == "gw-2"
    assert without(group, "gw-3", order).root == "gw-1"


def test_the_score_is_the_papers() -> None:
    """Idle capacity, data and warmth, each with its weight."""
    assert score(Standing(gateway="g", load=0.25, near=0.5, warm=1.0), WEIGHTS) == 0.4 * 0.75 + 0.3 * 0.5 + 0.3
