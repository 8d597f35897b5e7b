"""Standing rules: when they hold, what they keep robots from, how a gateway keeps them, what is no rule."""

from collections.abc import AsyncIterator
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any
from zoneinfo import ZoneInfo

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.closures.keeper import Closures
from appliance.errors import NotFoundError, PayloadError
from appliance.llm.checks.safety import kept_from, unsafe
from appliance.llm.settings import OutOfUse, PlanContext, SafetyConfig
from appliance.model import Place, Plan, RobotInfo, Site, Subtask, Word, encode, keyspace
from appliance.model.closures import DAY_MIN, CloseAsk, Closure, ClosuresAsk, ReopenAsk, Rule
from appliance.plane.events import AuthorityChanged, FleetEvent, Stage
from appliance.skills.catalogue import load_catalogue
from tests.unit.closures.test_keeper import Clock
from tests.unit.tasks.fake_plane import FakePlane

if TYPE_CHECKING:
    from appliance.skills.catalogue import Catalogue

SITE = Site(
    places={
        "dock 2": Place(x=1.0, y=2.0, aliases=("second dock",)),
        "aisle": Place(x=9.0, y=0.0),
        "home": Place(x=0.0, y=0.0),
    }
)
ARM = ("base", "arm")
ROBOTS = (
    RobotInfo(id="drone_1", kind="mavlink", uses=("base",), verbs=("goto", "state", "hold", "return_home"), flies=True),
    RobotInfo(id="rover_1", kind="zenoh", uses=ARM, verbs=("goto", "state", "hold", "pick", "return_home")),
    RobotInfo(id="rover_2", kind="zenoh", uses=ARM, verbs=("goto", "state", "hold", "pick", "return_home")),
)


def timed(begin: int, length: int, days: list[int], zone: str) -> Rule:
    """Return a rule that begins at a minute of the day and holds for so many."""
    end = (begin + length) % DAY_MIN or DAY_MIN
    return Rule(places=("aisle",), begin_min=begin, end_min=end, days=tuple(days), zone=zone)


rules = st.builds(
    timed,
    st.integers(0, DAY_MIN - 1),
    st.integers(1, DAY_MIN - 1),
    st.lists(st.integers(0, 6), max_size=3, unique=True),
    st.sampled_from(("UTC", "Europe/Zurich", "America/New_York", "Asia/Kathmandu")),
)


@pytest.fixture(scope="module")
def catalogue() -> "Catalogue":
    """Return the product's skills."""
    return load_catalogue()


def standing(rule: Rule) -> Closure:
    """Return a rule as a gateway keeps it."""
    return Closure(kind="rule", name="r-1", rule=rule, by=Word(by="ann", why="wet"))


def step(skill: str, robot: str, **params: object) -> Subtask:
    """Return a subtask."""
    return Subtask(id="s1", skill=skill, robot=robot, params=params)


# --- when --------------------------------------------------------------------------------------------------------


@given(rule=rules, at=st.datetimes(min_value=datetime(2020, 1, 1), max_value=datetime(2035, 1, 1)))  # noqa: DTZ001
def test_a_rule_holds_at_its_hours_and_no_other(rule: Rule, at: datetime) -> None:
    """By the clock on the wall of its zone, over midnight and over changes of the clocks; days count from its begin."""
    now = at.replace(tzinfo=UTC)
    wall = now.astimezone(ZoneInfo(rule.zone)).replace(tzinfo=None)
    length = (rule.end_min - rule.begin_min) % DAY_MIN or DAY_MIN
    since = (wall.hour * 60 + wall.minute - rule.begin_min) % DAY_MIN
    began = wall - timedelta(minutes=since)
    expected = since < length and (not rule.days or began.weekday() in rule.days)
    assert rule.due(int(now.timestamp()) * 10**9) is expected


def test_a_rule_without_hours_always_holds() -> None:
    """And one whose zone this gateway does not know: it forbids rather more than less."""
    assert Rule(places=("aisle",)).due(0)
    assert Rule(places=("aisle",), begin_min=5, zone="Mars/Olympus").due(0)


def test_a_rule_is_told_in_words() -> None:
    """Who, what, when; the id is that of what it says."""
    rule = Rule(robots=("rover_1",), places=("dock 2",), begin_min=1320, end_min=360, days=(5, 6), zone="Europe/Zurich")
    assert rule.text == "rover_1: never go to dock 2 from 22:00 to 06:00 on sat, sun Europe/Zurich"
    assert Rule(group="flying", things=("glass",)).text == "flying robots: never take up glass"
    assert Rule(begin_min=1320).text == "all robots: never start any subtask from 22:00 to 24:00 UTC"
    assert rule.id == replace(rule).id != replace(rule, begin_min=1319).id
    assert standing(rule).text.endswith("Europe/Zurich; by ann: wet")


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{"places":["aisle"],"things":["glass"]}',
        '{"places":["aisle"],"begin_min":60,"end_min":60}',
        '{"places":["aisle"],"begin_min":1440}',
        '{"things":["--"]}',
        '{"places":["aisle"],"days":[7]}',
        '{"places":[""]}',
        '{"places":["aisle"],"group":"swimming"}',
    ],
)
def test_what_is_no_rule_is_not_read(text: str) -> None:
    """Nothing that it says, hours that begin when they end, values out of bounds."""
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(text, type=Rule)


def test_a_rule_that_says_nothing_is_no_closure() -> None:
    """A record of the kind without its content would hold nothing up, unseen."""
    with pytest.raises(msgspec.ValidationError, match="has a rule"):
        msgspec.json.decode(b'{"kind":"rule","name":"r-1","by":{"by":"ann"}}', type=Closure)


# --- what --------------------------------------------------------------------------------------------------------

DOCK, AISLE = Rule(places=("dock 2",)), Rule(robots=("rover_1",), places=("aisle",))
GLASS = Rule(robots=("rover_1",), things=("glass",))


@pytest.mark.parametrize(
    ("rule", "subtask", "kept"),
    [
        (DOCK, step("goto", "rover_1", place="the second dock"), True),
        (DOCK, step("goto", "rover_1", place="1, 2"), True),
        (DOCK, step("goto", "rover_1", place="aisle"), False),
        (AISLE, step("goto", "rover_1", place="aisle"), True),
        (AISLE, step("goto", "rover_2", place="aisle"), False),
        (Rule(group="flying", places=("aisle",)), step("goto", "drone_1", place="aisle"), True),
        (Rule(group="flying", places=("aisle",)), step("goto", "rover_1", place="aisle"), False),
        (Rule(group="ground", places=("aisle",)), step("goto", "drone_1", place="aisle"), False),
        (Rule(places=("home",)), step("return_home", "rover_1"), True),
        (GLASS, step("pick", "rover_1", object="glass bottle"), True),
        (GLASS, step("pick", "rover_1", object="the Glasses"), True),
        (GLASS, step("pick", "rover_1", object="red box"), False),
        (Rule(things=("red box",)), step("pick", "rover_1", object="box"), True),
        (Rule(things=("red box",)), step("pick", "rover_1", object="blue box"), False),
        (GLASS, step("pick", "rover_2", object="glass"), False),
        (GLASS, step("place", "rover_1", object="glass", at="dock 2"), False),
        (GLASS, step("photograph", "rover_1", target="glass"), False),
        (GLASS, step("handover", "rover_2", object="glass", to="rover_1"), True),
        (GLASS, step("lift_together", "any1", object="glass", robots=["rover_1", "rover_2"], to="dock 2"), True),
        (Rule(robots=("rover_1",), things=("anything",)), step("pick", "rover_1", object="box"), True),
        (Rule(robots=("rover_1",), things=("anything",)), step("goto", "rover_1", place="aisle"), False),
        (Rule(robots=("rover_1",), begin_min=1), step("wait_for", "rover_1", seconds=1), True),
        (Rule(robots=("rover_1",), begin_min=1), Subtask(id="s1", skill="report"), False),
        (GLASS, step("pick", "any", object="glass"), False),
        (replace(GLASS, robots=()), step("pick", "any", object="glass"), True),
        (AISLE, step("goto", "all", place="aisle"), True),
        (Rule(group="flying", places=("aisle",)), step("goto", "any1", place="aisle"), False),
    ],
)
def test_a_plan_against_a_rule_is_refused(rule: Rule, subtask: Subtask, kept: bool, catalogue: "Catalogue") -> None:
    """With the rule, who added it and why. One whose robot is still to be chosen passes while another can do it."""
    context = PlanContext(instruction="", robots=ROBOTS, site=SITE, out_of_use=OutOfUse(rules=(standing(rule),)))
    found = unsafe(Plan(domain="any", subtasks=(subtask,)), context, catalogue, SafetyConfig())
    assert bool(found) is kept
    if kept:
        assert "is kept from it by standing rule r-1" in found[0]
        assert "by ann: wet" in found[0]


@given(
    rule=st.builds(
        Rule,
        robots=st.lists(st.sampled_from([each.id for each in ROBOTS]), max_size=2, unique=True).map(tuple),
        group=st.sampled_from(("all", "flying", "ground")),
        places=st.lists(st.sampled_from(list(SITE.places)), min_size=1, max_size=2, unique=True).map(tuple),
    ),
    more=st.lists(rules, max_size=2),
    robot=st.sampled_from([each.id for each in ROBOTS]),
    place=st.sampled_from(list(SITE.places)),
)
def test_rules_only_add_up(rule: Rule, more: list[Rule], robot: str, place: str) -> None:
    """A further rule allows nothing, and a rule for all robots keeps each from what a rule for it keeps it from."""
    catalogue, subtask = load_catalogue(), step("goto", robot, place=place)

    def kept(*said: Rule) -> bool:
        context = PlanContext(
            instruction="", robots=ROBOTS, site=SITE, out_of_use=OutOfUse(rules=tuple(map(standing, said)))
        )
        return bool(kept_from(subtask, robot, context, catalogue))

    assert kept(*more, rule) >= kept(rule)
    assert kept(replace(rule, robots=(), group="all")) >= kept(rule)
    assert kept(replace(rule, robots=(), group="all")) is (place in rule.places)


# --- kept --------------------------------------------------------------------------------------------------------


@pytest.fixture
def plane() -> FakePlane:
    """Return a plane of one gateway and the robots."""
    made = FakePlane()
    made.present = {"gw-1"}
    made.registry.robots = {each.id: each for each in ROBOTS}
    return made


@pytest.fixture
async def kept(plane: FakePlane) -> AsyncIterator[Closures]:
    """Return what gw-1 keeps."""
    real: Any = plane
    made = Closures(real, SITE, now_ns=Clock())
    await made.start(lambda _, handler: handler)
    yield made
    await made.close()


@pytest.mark.anyio
async def test_a_rule_is_added_listed_and_removed(plane: FakePlane, kept: Closures) -> None:
    """However it is written it is one; parts of the gateway are told; older gateways do not see it among places."""
    told: list[FleetEvent] = []
    plane.events.subscribe(Stage.TASKS, told.append)
    asked = Rule(robots=("rover_1", "rover_1"), places=("the second dock",), zone="Europe/Zurich")
    added = await kept.close_ask(CloseAsk(kind="rule", name="x", rule=asked, by="ann", why="wet"))
    assert added.rule == Rule(robots=("rover_1",), places=("dock 2",))
    again = await kept.close_ask(CloseAsk(kind="rule", name="x", rule=added.rule, by="bob"))
    assert again.name == added.name
    found = await kept.closures(ClosuresAsk(local=True))
    assert (found.closures, found.rules) == ((), (again,))
    assert (kept.rules, kept.places, kept.robots) == ((again,), {}, {})
    assert plane.session.sent(plane.keys(keyspace.CLOSURE, "*"), Closure)[-1] == again
    assert await kept.reopen(ReopenAsk(kind="rule", name=added.name, by="ann")) == again
    assert kept.rules == ()
    assert [type(each) for each in told] == [AuthorityChanged, AuthorityChanged]
    with pytest.raises(NotFoundError, match="not a standing rule") as refused:
        await kept.reopen(ReopenAsk(kind="rule", name=added.name))
    assert "swiftbot rules list" in str(refused.value.remedy)


@pytest.mark.parametrize(
    ("skill", "kept"), [("takeoff", True), ("land", False), ("return_home", False), ("hold", False)]
)
def test_hours_leave_no_drone_in_the_air(skill: str, kept: bool, catalogue: "Catalogue") -> None:
    """Where nothing begins at night, what ends a flight does."""
    night = Rule(group="flying", begin_min=22 * 60, end_min=6 * 60)
    context = PlanContext(instruction="", robots=ROBOTS, site=SITE, out_of_use=OutOfUse(rules=(standing(night),)))
    assert bool(kept_from(step(skill, "drone_1"), "drone_1", context, catalogue)) is kept


@pytest.mark.anyio
async def test_the_hours_of_a_rule_begin_and_end(plane: FakePlane, kept: Closures) -> None:
    """Outside them it is listed and forbids nothing, and its record stays; parts are told when they begin and end."""
    clock: Any = kept._now_ns  # pyright: ignore[reportPrivateUsage]
    clock.now = int(datetime(2026, 11, 28, 21, 59, tzinfo=UTC).timestamp()) * 10**9
    told: list[FleetEvent] = []
    plane.events.subscribe(Stage.TASKS, told.append)
    rule = Rule(places=("aisle",), begin_min=22 * 60, end_min=6 * 60)
    added = await kept.close_ask(CloseAsk(kind="rule", name="x", rule=rule, by="ann"))
    for hours, holds in ((0, False), (1, True), (8, True), (9, False)):
        clock.now = int(datetime(2026, 11, 28, 21, 59, tzinfo=UTC).timestamp() + hours * 3600) * 10**9
        kept._look()  # pyright: ignore[reportPrivateUsage]
        await kept._remove_old()  # pyright: ignore[reportPrivateUsage]
        assert bool(kept.rules) is holds
        assert (await kept.closures(ClosuresAsk())).rules == (added,)
    assert len(told) == 2


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("ask", "error", "says"),
    [
        (CloseAsk(kind="rule", name="x", rule=Rule(places=("dock 9",))), NotFoundError, "dock 9"),
        (CloseAsk(kind="rule", name="x", rule=replace(DOCK, robots=("rover_9",))), NotFoundError, "rover_9"),
        (CloseAsk(kind="rule", name="x", rule=Rule(begin_min=9, zone="Mars/Olympus")), PayloadError, "Mars"),
        (CloseAsk(kind="rule", name="x", rule=Rule(begin_min=9, zone="../../etc/passwd")), PayloadError, "zone"),
        (CloseAsk(kind="rule", name="x"), PayloadError, "what it says"),
        (CloseAsk(kind="place", name="aisle", rule=DOCK), PayloadError, "what it says"),
        (CloseAsk(kind="rule", name="x", rule=DOCK, until_ns=5), PayloadError, "is over"),
    ],
)
async def test_a_rule_that_cannot_be_kept_is_refused(
    ask: CloseAsk, error: type[Exception], says: str, plane: FakePlane, kept: Closures
) -> None:
    """A name that is mistyped would forbid nothing: it is an error with what there is, and nothing is written."""
    with pytest.raises(error, match=says) as refused:
        await kept.close_ask(ask)
    assert getattr(refused.value, "remedy", "")
    assert (plane.dht.records, kept.rules) == ({}, ())


@pytest.mark.anyio
async def test_a_gateway_that_starts_learns_rules_from_the_others(plane: FakePlane) -> None:
    """Also where it holds no copy, and after its own restart from its records."""
    real: Any = plane
    rule = Closure(kind="rule", name=DOCK.id, rule=DOCK, by=Word(by="ann", at_ns=1))
    plane.dht.records.clear()
    await plane.dht.write(keyspace.CLOSURE_RECORD.key(rule.id), encode(rule), expected=None)
    made = Closures(real, SITE, now_ns=Clock())
    await made.start(lambda _, handler: handler)
    try:
        assert made.rules == (rule,)
    finally:
        await made.close()
