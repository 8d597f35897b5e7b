"""What handlers ask for, on fakes: busy robots, notices once across attempts, hostile arguments."""

import asyncio
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import PayloadError, RefusedError, RobotError
from appliance.model import Failure, Need, Notice, RobotCommand, RobotInfo, RobotReply, RunRequest, encode, keyspace
from appliance.pool.pool import Call
from appliance.tasks import handler_calls as module
from appliance.tasks.artifacts import Artifacts
from appliance.tasks.handler_calls import Calls

pytestmark = pytest.mark.anyio

RUN = RunRequest(task="t-1", subtask="s1", attempt=1, skill="work", need=Need(image="base"), robot="r1")


@pytest.fixture
def waits() -> list[str]:
    """Collect the notes of waits."""
    return []


@pytest.fixture
def calls(plane: Any, folder: Path, waits: list[str], monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Return calls on fakes, with a short pause for busy robots."""
    monkeypatch.setattr(module, "BUSY_RETRY_S", 0.01)
    artifacts = Artifacts(folder, gateway="gw-1", max_bytes=1000)
    return Calls(plane, artifacts, on_wait=lambda _, note: waits.append(note))


def ask(name: str, run: RunRequest = RUN, /, **args: Any) -> Call:
    """Return a handler's call."""
    return Call(run=run, number=1, name=name, args=args)


async def test_a_busy_robot_is_waited_for_with_a_note(calls: Calls, plane: Any, waits: list[str]) -> None:
    """Busy is no failure: it is asked again under the same id, and people get a notice."""
    busy = RobotReply(id="t-1/s1/1", failure=Failure(code="busy", message="arm in use"))
    plane.session.replies = [encode(busy), encode(busy), encode(RobotReply(id="t-1/s1/1", result={"at": "dock"}))]
    assert await calls(ask("command", verb="goto", args={})) == {"at": "dock"}
    assert waits == ["waits for r1: arm in use"] * 2
    assert len(set(plane.session.queries)) == 1


async def test_a_robot_that_stays_busy_is_an_error_in_time(calls: Calls, plane: Any) -> None:
    """The wait ends with the command's own deadline."""
    plane.session.replies = [encode(RobotReply(id="t-1/s1/1", failure=Failure(code="busy", message="arm in use")))]
    with pytest.raises(RobotError, match="arm in use"):
        await calls(ask("command", verb="goto", timeout_s=0.5))


async def test_an_order_is_held_to_its_limits_before_it_is_sent(plane: Any, folder: Path) -> None:
    """What its plan did not ask for may be lowered; what may not be sent is the handler's to see, and is not sent."""
    seen: list[frozenset[str]] = []

    def orders(robot: str, command: RobotCommand, chosen: frozenset[str], begun: bool) -> RobotCommand:
        assert not begun
        seen.append(chosen)
        if command.verb == "takeoff":
            raise RefusedError(f"not sent to {robot}: too high")
        return replace(command, args=command.args | {"speed_mps": 1.0})

    calls = Calls(plane, Artifacts(folder, gateway="gw-1", max_bytes=1000), on_wait=lambda *_: None, orders=orders)
    plane.session.replies = [encode(RobotReply(id="t-1/s1/1"))]
    await calls(ask("command", verb="goto", args={"speed_mps": 9.0}))
    assert b'"speed_mps":1.0' in plane.session.queries[0]
    run = replace(RUN, params={"speed_mps": 2.0, "place": "x"})
    with pytest.raises(RefusedError, match="too high"):
        await calls(ask("command", run, verb="takeoff"))
    assert seen == [frozenset({"speed_mps", "altitude_m"}), frozenset({"altitude_m"})]
    assert len(plane.session.queries) == 1


async def test_an_order_is_looked_at_right_before_it_is_sent(
    plane: Any, folder: Path, waits: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the wait for a robot that is stopped, and again after each time that it was busy."""
    monkeypatch.setattr(module, "BUSY_RETRY_S", 0.01)
    asked: list[int] = []

    def hindrance(robot: str) -> str:
        del robot
        return "" if len(waits) >= 2 else "stopped by ann"

    def orders(robot: str, command: RobotCommand, chosen: frozenset[str], begun: bool) -> RobotCommand:
        del chosen, begun
        asked.append(len(waits))
        if len(asked) == 3:
            raise RefusedError(f"not sent to {robot}: the way is closed now")
        return command

    calls = Calls(
        plane,
        Artifacts(folder, gateway="gw-1", max_bytes=1000),
        on_wait=lambda _, note: waits.append(note),
        hindrance=hindrance,
        orders=orders,
    )
    plane.session.replies = [encode(RobotReply(id="t-1/s1/1", failure=Failure(code="busy", message="arm in use")))]
    with pytest.raises(RefusedError, match="the way is closed now"):
        await calls(ask("command", verb="goto"))
    assert asked == [2, 3, 4]
    assert len(plane.session.queries) == 2


@pytest.mark.parametrize(
    ("run", "begun"), [(RUN, False), (replace(RUN, attempt=2), True), (replace(RUN, resume={"step": 3}), True)]
)
async def test_an_order_of_a_later_attempt_may_be_begun(plane: Any, folder: Path, run: RunRequest, begun: bool) -> None:
    """Its id is that of the earlier attempt's order, which the robot may be carrying out."""
    seen: list[bool] = []

    def orders(robot: str, command: RobotCommand, chosen: frozenset[str], begun: bool) -> RobotCommand:
        del robot, chosen
        seen.append(begun)
        return command

    calls = Calls(plane, Artifacts(folder, gateway="gw-1", max_bytes=1000), on_wait=lambda *_: None, orders=orders)
    plane.session.replies = [encode(RobotReply(id="t-1/s1/1"))]
    await calls(ask("command", run, verb="goto"))
    assert seen == [begun]


@pytest.mark.parametrize("given", [float("nan"), float("inf"), -1, 0, "soon", True, 1e300, None])
async def test_a_deadline_that_is_none_is_refused(calls: Calls, given: Any) -> None:
    """Not-a-number would have waited for ever."""
    with pytest.raises(PayloadError, match="timeout_s"):
        await calls(ask("command", verb="goto", timeout_s=given))


async def test_other_nonsense_is_refused(calls: Calls) -> None:
    """Unknown calls, arguments that are no table, files that are no bytes, references that are none."""
    for call in (
        ask("format_disk"),
        ask("command", verb="goto", args=[1]),
        ask("command", replace(RUN, robot=None), verb="goto"),
        ask("put_artifact", name="x", data=7),
        ask("put_artifact", name="x", data="%%"),
        ask("get_artifact", ref="x"),
        ask("get_artifact", ref={"artifact": "../../etc/passwd"}),
    ):
        with pytest.raises(PayloadError):
            await calls(call)


async def test_a_notice_is_sent_once_across_attempts(calls: Calls, plane: Any) -> None:
    """The second attempt finds that the first has sent it."""
    await calls(ask("notify", to="Opérator ", text="done \ud800"))
    again = await calls(ask("notify", replace(RUN, attempt=2), to="Opérator ", text="done"))
    assert again["repeated"]
    sent = plane.session.sent(plane.keys(keyspace.NOTICE, "op_rator"), Notice)
    assert [each.id for each in sent] == ["t-1/s1/1"]


async def test_a_notice_that_was_begun_and_not_sent_is_sent(calls: Calls, plane: Any) -> None:
    """A gateway that died between the promise and the sending loses nothing."""
    await plane.dht.write("effect/t-1/s1/1", b'{"done":false}', expected=None)
    await calls(ask("notify", replace(RUN, attempt=2), to="operator", text="done"))
    assert len(plane.session.sent(plane.keys(keyspace.NOTICE, "operator"), Notice)) == 1


async def test_a_file_is_kept_and_found_again(calls: Calls) -> None:
    """Put gives a reference, get the bytes."""
    reference = await calls(ask("put_artifact", name="a.txt", data=b"text", media_type="text/plain"))
    assert (await calls(ask("get_artifact", ref=reference)))["data"] == b"text"


@pytest.fixture
def hindered(plane: Any, folder: Path, waits: list[str], monkeypatch: pytest.MonkeyPatch) -> tuple[Calls, list[str]]:
    """Return calls of a gateway that gives robots no commands while the list holds a reason."""
    monkeypatch.setattr(module, "BUSY_RETRY_S", 0.01)
    monkeypatch.setattr(module, "HEARD_S", 0.2)
    artifacts = Artifacts(folder, gateway="gw-1", max_bytes=1000)
    reasons: list[str] = []

    def hindrance(robot: str) -> str:
        assert robot == "r1"
        return reasons[0] if reasons else ""

    return Calls(plane, artifacts, on_wait=lambda _, note: waits.append(note), hindrance=hindrance), reasons


async def test_a_stopped_robot_is_given_no_command(
    hindered: tuple[Calls, list[str]], plane: Any, waits: list[str]
) -> None:
    """The handler waits with the reason, and its command goes out when the stop is lifted."""
    calls, reasons = hindered
    plane.session.replies = [encode(RobotReply(id="t-1/s1/1", result={"at": "dock"}))]
    reasons.append("stopped by ann: a person")
    command = asyncio.create_task(calls(ask("command", verb="goto", args={})))
    async with asyncio.timeout(60):
        while not waits:
            await asyncio.sleep(0.005)
    assert set(waits) == {"waits for r1: stopped by ann: a person"}
    assert not plane.session.queries
    reasons.clear()
    assert await asyncio.wait_for(command, 60) == {"at": "dock"}


async def test_a_robot_that_stays_stopped_is_an_error_in_time(hindered: tuple[Calls, list[str]], plane: Any) -> None:
    """The wait ends with the command's own deadline, and says who stopped it."""
    calls, reasons = hindered
    reasons.append("stopped by ann")
    with pytest.raises(RobotError, match="r1 is stopped by ann"):
        await calls(ask("command", verb="goto", timeout_s=0.5))
    assert not plane.session.queries


async def test_a_command_that_a_stop_has_ended_is_no_failure_of_the_handler(
    hindered: tuple[Calls, list[str]], plane: Any, waits: list[str]
) -> None:
    """The robot heard of the stop first: the handler is not told, since its task ends the run meanwhile."""
    calls, reasons = hindered
    plane.session.replies = [
        encode(RobotReply(id="t-1/s1/1", failure=Failure(code="cancelled", message="stopped on request")))
    ]
    command = asyncio.create_task(calls(ask("command", verb="goto", args={})))
    async with asyncio.timeout(60):
        while not plane.session.queries:
            await asyncio.sleep(0.002)
    reasons.append("stopped by ann")
    async with asyncio.timeout(60):
        while not waits:
            await asyncio.sleep(0.005)
    assert not command.done()
    command.cancel()
    await asyncio.gather(command, return_exceptions=True)


async def test_a_robot_that_is_lost_during_its_command_is_waited_for_with_the_reason(
    calls: Calls, plane: Any, waits: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run's note says for which robot it waits, since when and what it holds; and that it is back."""
    monkeypatch.setattr(module, "LOST_LOOK_S", 0.01)
    answer = asyncio.Event()

    async def sent(*_: Any, **__: Any) -> RobotReply:
        await answer.wait()
        return RobotReply(id="t-1/s1/1", result={"at": "dock"})

    monkeypatch.setattr(module, "send_command", sent)
    robot = RobotInfo(id="r1", kind="zenoh", holding="red box")
    plane.registry.robots["r1"] = robot
    running = asyncio.create_task(calls(ask("command", verb="goto", args={})))
    for info, told in ((replace(robot, online=False), 1), (robot, 2)):
        plane.registry.robots["r1"] = info
        plane.registry.lost_ns = {} if info.online else {"r1": 1_700_000_000_000_000_000}
        async with asyncio.timeout(60):
            while len(waits) < told:
                await asyncio.sleep(0.001)
    assert waits == ["waits for robot r1, lost since 22:13:20 UTC, while it held the red box", "r1 is back"]
    answer.set()
    assert await running == {"at": "dock"}


async def test_another_part_of_the_gateway_answers_what_it_offers(calls: Calls) -> None:
    """By name; what nobody offers is refused, as before."""

    async def masks(call: Call) -> dict[str, Any]:
        return {"masks": call.args["epoch"]}

    with pytest.raises(PayloadError, match="'masks'"):
        await calls(ask("masks", epoch="e"))
    calls.offer("masks", masks)
    assert await calls(ask("masks", epoch="e")) == {"masks": "e"}
