"""Tasks that robots ask for."""

import msgspec
import pytest

from appliance.errors import PayloadError
from appliance.plane.session import Message
from appliance.robots.intake import MAX_BYTES, read_request


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


def test_a_given_id_and_submitter_are_kept() -> None:
    """What the robot says about its request stands."""
    _, request = read_request(message(b'{"instruction": "go", "id": "mine", "submitter": "ana"}'))
    assert (request.id, request.submitter) == ("mine", "ana")


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
        msgspec.json.encode({"instruction": "x" * 5000}),
        msgspec.json.encode({"instruction": "x" * MAX_BYTES}),
    ],
)
def test_what_is_no_request_is_refused(payload: bytes) -> None:
    """Malformed, empty, oversize and misnamed requests are PayloadErrors."""
    with pytest.raises(PayloadError):
        read_request(message(payload))
