"""What handlers ask for, on fakes: busy robots, notices once across attempts, hostile arguments."""

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import PayloadError, RobotError
from appliance.model import Failure, Need, Notice, RobotReply, RunRequest, encode
from appliance.pool.pool import Call
from appliance.tasks import calls as module
from appliance.tasks.artifacts import Artifacts
from appliance.tasks.calls import Calls

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
    """Busy is no failure: it is asked again under the same id, and people are told."""
    busy = RobotReply(id="t-1/s1/1", failure=Failure(code="busy", message="arm in use"))
    plane.session.replies = [encode(busy), encode(busy), encode(RobotReply(id="t-1/s1/1", result={"at": "dock"}))]
    assert await calls(ask("command", verb="goto", args={})) == {"at": "dock"}
    assert waits == ["waits for r1: arm in use"] * 2
    assert len(set(plane.session.queries)) == 1


async def test_a_robot_that_stays_busy_is_an_error_in_time(calls: Calls, plane: Any) -> None:
    """The wait ends with the command's own deadline."""
    plane.session.replies = [encode(RobotReply(id="t-1/s1/1", failure=Failure(code="busy", message="arm in use")))]
    with pytest.raises(RobotError, match="arm in use"):
        await calls(ask("command", verb="goto", timeout_s=0.05))


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
    sent = plane.session.sent(plane.keys.notice("op_rator"), Notice)
    assert [each.id for each in sent] == ["t-1/s1/1"]


async def test_a_notice_that_was_begun_and_not_sent_is_sent(calls: Calls, plane: Any) -> None:
    """A gateway that died between the promise and the sending loses nothing."""
    await plane.dht.write("effect/t-1/s1/1", b'{"done":false}', expected=None)
    await calls(ask("notify", replace(RUN, attempt=2), to="operator", text="done"))
    assert len(plane.session.sent(plane.keys.notice("operator"), Notice)) == 1


async def test_a_file_is_kept_and_found_again(calls: Calls) -> None:
    """Put gives a reference, get the bytes."""
    reference = await calls(ask("put_artifact", name="a.txt", data=b"text", media_type="text/plain"))
    assert (await calls(ask("get_artifact", ref=reference)))["data"] == b"text"
