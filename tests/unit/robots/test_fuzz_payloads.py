"""Whatever a robot puts on its keys: counted, never believed where it cannot be, and never a crash."""

import json
import math
import struct
from collections import Counter
from typing import Any, cast

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.model import RobotInfo, TaskRequest, encode
from appliance.model.robots import plausible
from appliance.plane.registry import Roster
from appliance.plane.session import Message as Put
from appliance.robots.task_listener import MAX_BYTES, read_request
from tests.unit.robots.test_executor import Robot

pytestmark = pytest.mark.anyio

LONG = "x" * 2**20
FIELDS = [each.encode_name for each in msgspec.structs.fields(RobotInfo)]

scalars = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**80), 2**80), st.floats(), st.text(max_size=40),
    st.sampled_from([LONG, "\0", "\x1b[2J", "\ud800", "NaN", 1e308, -1e308, 10**400, math.nan, math.inf]),
)  # fmt: skip
values = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=5), st.dictionaries(st.sampled_from([*FIELDS, "x", "y", "z"]), inner, max_size=6)
    ),
    max_leaves=12,
)
states = st.dictionaries(st.sampled_from(FIELDS), values, max_size=8).map(
    lambda fields: {"id": "cart_1", "kind": "zenoh"} | fields
)


def nested(depth: int, inside: bytes = b"1") -> bytes:
    """Return JSON that is so deep."""
    return b'{"id": "cart_1", "kind": "zenoh", "pose": ' + b'{"x": ' * depth + inside + b"}" * (depth + 1)


def as_json(value: Any) -> bytes:
    """Return a value as Python's own encoder writes it: NaN, infinities and lone surrogates included."""
    return json.dumps(value).encode("utf-8", "surrogatepass")


payloads = st.one_of(
    states.map(as_json),
    values.map(as_json),
    st.binary(max_size=200),
    states.map(lambda state: as_json(state)[:-1]),
    st.integers(0, 100_000).map(nested),
    st.dictionaries(st.sampled_from(FIELDS), st.floats() | st.text(max_size=9), max_size=8).map(msgspec.msgpack.encode),
)


class Ears:
    """A session that counts what is refused."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()

    def refuse(self, what: str, **_: Any) -> None:
        """Count bad input."""
        self.refused[what] += 1


def put(payload: bytes, *, robot: str = "cart_1") -> tuple[Roster, Counter[str]]:
    """Put a state on a robot's key; return the roster and what was refused."""
    ears = Ears()
    roster = Roster(cast("Any", ears), on_change=lambda: None)
    cast("Any", roster)._heard(Put(f"swiftbot/test/robot/{robot}/state", payload, False, 0, ""))
    return roster, ears.refused


@given(payloads)
@example(nested(1_000_000))
@example(b"[" * 2_000_000)
@example(as_json({"id": "cart_1", "kind": LONG, "note": LONG, "verbs": [LONG]}))
@example(b'{"id": "cart_1", "battery_percent": ' + b"9" * 2**20 + b"}")
@example(b"\xff" * 2**20)
def test_any_state_is_shown_where_it_can_be_and_counted_where_not(payload: bytes) -> None:
    """Either the robot is in the list with nothing absurd, or it is not there and that is counted."""
    roster, refused = put(payload)
    if not roster.robots:
        assert refused.total() == 1
        return
    (info,) = roster.robots.values()
    assert info.id == "cart_1"
    assert plausible(info) == (info, ())
    raw = encode(info)
    assert len(raw) < 2**17
    assert msgspec.json.decode(raw, type=RobotInfo) == info
    text = raw.decode()
    assert "NaN" not in text
    assert "Infinity" not in text


@given(st.text(max_size=80))
@example("*")
@example("**")
@example("cart_1\x1b[2J")
@example("x" * 64)
@example("$*")
@example("@adv")
def test_a_robot_of_no_name_is_none(name: str) -> None:
    """A key with a wildcard names all robots, so no robot is shown by it, nor by what could be no name."""
    good = msgspec.json.encode({"id": name.replace("/", ""), "kind": "zenoh"})
    roster, refused = put(good, robot=name.replace("/", ""))
    assert bool(roster.robots) != bool(refused)
    for each in roster.robots:
        assert 1 <= len(each) <= 63
        assert not set(each) & set("*$#?/@ \x1b")
    other = Roster(cast("Any", Ears()), on_change=lambda: None)
    other.take([RobotInfo(id=name, kind="zenoh")])
    assert set(other.robots) <= {name}
    assert not set("".join(other.robots)) & set("*$#?/@ ")


requests = st.dictionaries(
    st.sampled_from([each.encode_name for each in msgspec.structs.fields(TaskRequest)]), values, max_size=6
).map(lambda fields: {"instruction": "go"} | fields)


@given(st.one_of(requests.map(as_json), payloads))
@example(as_json({"instruction": LONG}))
@example(b'{"instruction": "go", "plan": ' + b"[" * 100_000)
def test_any_request_of_a_robot_is_one_or_refused(payload: bytes) -> None:
    """What is taken is the robot's own, small, and can be kept; the rest is a PayloadError."""
    try:
        robot, request = read_request(Put("swiftbot/test/robot/cart_1/task", payload, False, 10**18, ""))
    except PayloadError:
        return
    assert (robot, request.submitter) == ("cart_1", "cart_1")
    assert len(payload) <= MAX_BYTES
    assert request.instruction.strip()
    assert msgspec.json.decode(encode(request), type=TaskRequest) == request


commands = st.fixed_dictionaries(
    {"id": st.sampled_from(["c1", "", "x" * 10_000, 5]), "verb": st.sampled_from(["goto", "state", "dance", "", LONG])},
    optional={
        "args": values, "attempt": values, "task": values,
        "deadline_s": st.sampled_from([0, -1, 1e308, math.nan, math.inf]),
    },
)  # fmt: skip


@given(st.one_of(commands.map(as_json), payloads))
async def test_any_command_is_answered_or_refused(payload: bytes) -> None:
    """Never carried out with arguments that are none, and never a crash of its server."""
    from tests.unit.robots.conftest import FakeSession, FakeStore  # noqa: PLC0415 - one for each example

    robot = Robot(FakeSession(), FakeStore())
    robot.gate.set()
    try:
        raw = await robot.desk.handle("swiftbot/test/robot/r/command", payload)
    except PayloadError:
        assert robot.refused == {"command_malformed": 1}
    else:
        answer = msgspec.json.decode(raw)
        assert len(raw) < 2**16
        assert answer.get("failure") or answer["result"]
    finally:
        await robot.desk.close()
    assert len(robot.done) <= 1


@given(st.lists(st.floats(), min_size=2, max_size=4), st.sampled_from(["x", "y", "z"]))
async def test_a_place_that_is_no_number_is_not_gone_to(found: list[float], axis: str) -> None:
    """`goto` with NaN or an infinity is refused before anything moves."""
    from tests.unit.robots.conftest import FakeSession, FakeStore  # noqa: PLC0415 - one for each example

    robot = Robot(FakeSession(), FakeStore())
    robot.gate.set()
    way = {"waypoints": [{"x": 1.0, "y": 2.0} | {axis: value} for value in found]}
    try:
        raw = await robot.desk.handle("k", as_json({"id": "c1", "verb": "goto", "args": way}))
        done = not msgspec.json.decode(raw).get("failure")
    except PayloadError:
        done = False
    finally:
        await robot.desk.close()
    assert not done or all(math.isfinite(value) for value in found)


def test_numbers_of_four_bytes_are_told_as_they_are() -> None:
    """A float that a robot rounded to four bytes is shown as such and decides nothing else."""
    (short,) = struct.unpack("<f", struct.pack("<f", 55.3))
    roster, refused = put(as_json({"id": "cart_1", "kind": "zenoh", "battery_percent": short}))
    assert roster.robots["cart_1"].battery_percent == short
    assert not refused
