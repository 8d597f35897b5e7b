"""Tasks that robots ask for."""

import msgspec
import pytest

from appliance.errors import PayloadError
from appliance.model import Plan, Provenance
from appliance.plane.session import Message
from appliance.robots.task_listener import MAX_BYTES, read_request


def message(payload: bytes, at_ns: int = 5_000_000_000) -> Message:
    """Make a put of rover_1."""
    return Message("swiftbot/f/robot/rover_1/task", payload, deleted=False, at_ns=at_ns, encoding="application/json")


def test_a_request_gets_an_id_and_its_submitter() -> None:
    """The same put has the same id wherever it is heard; the same wish a minute later has another."""
    robot, one = read_request(message(b'{"instruction": "charge me"}'))
    _, same = read_request(message(b'{"instruction": "charge me"}'))
    _, later = read_request(message(b'{"instruction": "charge me"}', at_ns=65_000_000_000))
    assert (robot, one.submitter) == ("rover_1", "rover_1")
    assert one.id == same.id != later.id


def test_a_given_id_is_kept_and_another_submitter_is_not() -> None:
    """A robot that names somebody else does not get his turns or what he may have done."""
    _, request = read_request(message(b'{"instruction": "go", "id": "mine", "submitter": "ana"}'))
    assert (request.id, request.submitter) == ("mine", "rover_1")


def test_where_a_plan_came_from_is_not_the_robots_to_say() -> None:
    """Provenance that a robot puts into its plan is taken out: it would get into the cache of plans made here."""
    plan = Plan(domain="navigation", subtasks=(), provenance=Provenance(tier="rules", confidence=1.0))
    _, request = read_request(message(msgspec.json.encode({"instruction": "go", "plan": plan})))
    assert request.plan is not None
    assert request.plan.provenance is None


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b"[]",
        b'{"instruction": 3}',
        b'{"instruction": "  "}',
        b'{"instruction": "go", "unknown": 1}',
        b'{"instruction": "go", "id": "../../etc"}',
        b"\xff\xfe",
        b'{"instruction": "go", "plan": ' + b'{"a":' * 6000 + b"1" + b"}" * 6001,
        b'{"instruction": ' + b"[" * 60_000,
        b'{"instruction": "go", "priority": ' + b"9" * 60_000 + b"}",
        b'{"instruction": "go", "deadline_s": 1e999}',
        b'{"instruction": "go", "id": "' + b"x" * 60_000 + b'"}',
        msgspec.json.encode({"instruction": "x" * 5000}),
        msgspec.json.encode({"instruction": "x" * MAX_BYTES}),
    ],
)
def test_what_is_no_request_is_refused(payload: bytes) -> None:
    """Malformed, empty, oversize and misnamed requests are PayloadErrors."""
    with pytest.raises(PayloadError):
        read_request(message(payload))
