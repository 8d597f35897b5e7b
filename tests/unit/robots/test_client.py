"""The client library over MAVLink: what it asks, whose answers it takes, and news that do not come."""

import itertools
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.robots import client as library
from appliance.robots.client import LOOK_S, TaskClient, TaskRejected
from appliance.robots.mavlink.tunnel import MAX_PAYLOAD, PAYLOAD_TYPE, Channel

PLAN = {
    "domain": "inspection",
    "subtasks": [{"id": "s1", "skill": "goto", "params": {"place": "gate"}, "robot": "drone_1"}],
}


class Gateway:
    """A connection of pymavlink's kind with a gateway at its other end; each look at it takes 50 ms."""

    def __init__(self) -> None:
        self.now = 100.0
        self.asked: list[dict[str, Any]] = []
        self.answer: Callable[[dict[str, Any]], list[dict[str, Any] | bytes]] = lambda letter: [accepted(letter)]
        self.mav = SimpleNamespace(tunnel_send=self._take, heartbeat_send=lambda *_: None)
        self.channel = Channel(itertools.count(9).__next__)

    def monotonic(self) -> float:
        """Tell the time."""
        return self.now

    def _take(self, _system: int, _component: int, _kind: int, length: int, payload: list[int]) -> None:
        whole = self.channel.take(bytes(payload[:length]), self.now)
        if whole is not None:
            letter = json.loads(whole)
            self.asked.append(letter)
            self.say(*self.answer(letter))

    def say(self, *messages: dict[str, Any] | bytes) -> None:
        """Tell the client something."""
        for each in messages:
            self.channel.send(each if isinstance(each, bytes) else json.dumps(each).encode(), self.now)

    def recv_match(self, *, blocking: bool, timeout: float = 0.0) -> Any:
        """Return what comes; after the time that it takes, None."""
        del timeout
        if not blocking:
            return None
        self.now += 0.05
        due = self.channel.due(self.now)
        for payload in due[1:]:
            self._client.handle(_tunnel(payload))
        return _tunnel(due[0]) if due else None

    def client(self) -> TaskClient:
        """Return a client of it."""
        self._client = TaskClient(self)
        return self._client


def _tunnel(payload: bytes) -> Any:
    return SimpleNamespace(
        get_type=lambda: "TUNNEL",
        get_srcSystem=lambda: 242,
        get_srcComponent=lambda: 191,
        payload_type=PAYLOAD_TYPE,
        payload_length=len(payload),
        payload=payload.ljust(MAX_PAYLOAD, b"\0"),
    )


def accepted(letter: dict[str, Any], state: str = "accepted") -> dict[str, Any]:
    """Return the answer to a letter."""
    return {"op": "accepted", "to": letter["op"], "id": letter["id"], "state": state}


def news(task: str, state: str, done: int = 0) -> dict[str, Any]:
    """Return how a task goes on."""
    return {"op": "news", "id": task, "state": state, "done": done, "total": 2}


@pytest.fixture
def gateway(monkeypatch: pytest.MonkeyPatch) -> Gateway:
    """Return a gateway whose time is the client's."""
    found = Gateway()
    monkeypatch.setattr(library, "time", found)
    return found


def test_words_and_whole_requests(gateway: Gateway) -> None:
    """Words alone travel as such; with a plan or a priority a whole request does, longer than a window of parts."""
    client = gateway.client()
    assert client.submit("look at the gate", task="t1") == "t1"
    assert client.submit("look", task="t2", plan=PLAN, priority=7, approval="always") == "t2"
    client.submit("look " * 700, task="t3", deadline_s=60.0)
    words, whole, long = gateway.asked
    assert words == {"op": "submit", "id": "t1", "instruction": "look at the gate"}
    request = {"instruction": "look", "plan": PLAN, "priority": 7, "approval": "always"}
    assert whole == {"op": "submit", "id": "t2", "request": request}
    assert long["request"]["deadline_s"] == 60.0


@pytest.mark.parametrize("plan", [{"x": "y" * 20_000}, {"x": object()}, {"x": {1, 2}}])
def test_requests_that_cannot_be_sent(gateway: Gateway, plan: dict[str, Any]) -> None:
    """Too long a plan, and one that is no plain data, are refused before anything is sent."""
    with pytest.raises(TaskRejected) as told:
        gateway.client().submit("look", plan=plan)
    assert told.value.code == "payload"
    assert gateway.asked == []


def test_news_that_do_not_come_are_asked_for(gateway: Gateway) -> None:
    """A gateway that was restarted knows of no follower: it is asked again, and what was told is not told twice."""
    client = gateway.client()
    client.submit("look", task="t1")
    gateway.say(news("t1", "running", 1))
    found = client.follow("t1", timeout_s=300.0)
    assert next(found)["done"] == 1
    ends = iter((news("t1", "running", 1), news("t1", "running", 1), news("t1", "succeeded", 2)))
    gateway.answer = lambda letter: [accepted(letter, "running"), next(ends)]
    before = gateway.now
    assert [each["state"] for each in found] == ["succeeded"]
    assert [each["op"] for each in gateway.asked] == ["submit", "follow", "follow", "follow"]
    assert gateway.now - before >= 3 * LOOK_S


def test_a_gateway_that_is_away_for_a_while(gateway: Gateway) -> None:
    """Questions into a link that is cut are no end of following, until its time is over."""
    client = gateway.client()
    client.submit("look", task="t1")
    found = client.follow("t1", timeout_s=600.0)
    deaf, gateway.mav.tunnel_send = gateway.mav.tunnel_send, lambda *_: None
    returns_at = gateway.now + 200.0

    def receive(**how: Any) -> Any:
        if gateway.now > returns_at:
            gateway.mav.tunnel_send = deaf
        return Gateway.recv_match(gateway, **how)

    gateway.recv_match = receive  # type: ignore[method-assign]
    gateway.answer = lambda letter: [accepted(letter), news("t1", "succeeded", 2)]
    assert [each["state"] for each in found] == ["succeeded"]
    gateway.answer = lambda letter: [accepted(letter)]
    with pytest.raises(TimeoutError):
        next(client.follow("t2", timeout_s=100.0))


def test_a_task_that_nobody_knows_any_more(gateway: Gateway) -> None:
    """Asked after, the gateway says that there is no such task: following ends with its reason, not in silence."""
    client = gateway.client()
    gateway.answer = lambda letter: [
        {"op": "rejected", "to": "follow", "id": letter["id"], "code": "not-found", "message": "no task t1"}
    ]
    with pytest.raises(TaskRejected, match="no task t1"):
        next(client.follow("t1"))
    busy = iter((True, False))
    gateway.answer = lambda letter: (
        [
            {
                "op": "rejected",
                "to": "follow",
                "id": letter["id"],
                "code": "refused",
                "message": "starting",
                "retry": True,
            }
        ]
        if next(busy)
        else [accepted(letter), news("t1", "failed")]
    )
    assert [each["state"] for each in client.follow("t1")] == ["failed"]


def test_an_answer_belongs_to_its_question(gateway: Gateway) -> None:
    """What comes late to an earlier question about a task is not taken for the answer to the next one."""
    client = gateway.client()
    client.submit("look", task="t1")
    late = {"op": "follow", "id": "t1"}
    gateway.say(accepted(late, "running"))
    gateway.answer = lambda letter: [accepted(late, "running"), accepted(letter, "cancelling")]
    assert client.cancel("t1") == "cancelling"
    gateway.say(accepted({"op": "cancel", "id": "t1"}, "stale"))
    while gateway.channel.due(gateway.now + 10.0):
        client.pump()
    gateway.answer = lambda letter: [accepted(letter, "cancelled")]
    assert client.cancel("t1") == "cancelled"


@pytest.mark.parametrize("noise", [b"", b"[]", b"null", b"{", b"\xff", b"[" * 16_000, b'{"op": 1}'])
def test_messages_that_are_none(gateway: Gateway, noise: bytes) -> None:
    """Whatever comes between the answers is passed over."""
    client = gateway.client()
    gateway.answer = lambda letter: [noise, accepted(letter)]
    assert client.submit("look", task="t1") == "t1"
