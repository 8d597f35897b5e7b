"""States of a newer version: shown by a sign of their own and their own word, made safe, wherever states stand."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import msgspec
import pytest

from appliance.model import (
    ContainerInfo,
    ContainerState,
    Plan,
    RobotInfo,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    encode,
)
from appliance.model.messages import enums_open
from appliance.tui.app import SwiftbotApp
from appliance.tui.settings import TuiConfig
from appliance.tui.subscriptions import Hearing

from .pictures import characters

if TYPE_CHECKING:
    from .conftest import FakeView

pytestmark = pytest.mark.anyio
STEP = Subtask(id="s1", skill="goto", robot="rover-9")


@pytest.fixture
def future(view: "FakeView") -> Iterator["FakeView"]:
    """Return a fleet of which some gateways are of a newer version, heard as it puts what it tells."""
    hearing = Hearing(view.store, "test")

    def hear(key: str, told: object, **more: object) -> None:
        message = msgspec.json.decode(encode(told)) | more
        assert hearing.hear(f"swiftbot/test/{key}", encode(message), 1), hearing.refused

    with enums_open():
        task = TaskRecord(
            id="t-new", instruction="x", state=TaskState.RUNNING, created_ns=99,
            plan=Plan(domain="d", subtasks=(STEP,)),
            subtasks=(SubtaskRecord(subtask=STEP, state=SubtaskState.RUNNING),),
        )  # fmt: skip
        step = msgspec.json.decode(encode(task.subtasks[0])) | {"state": "levi\x1b[5mtating", "lift_n": 3}
        hear("task/t-new/record", task, state="drea\x1b[31m[red]ming", mood={"of": "hope"}, subtasks=[step])
        container = ContainerInfo(id="c9", gateway="gw-a", image="base", state=ContainerState.READY)
        hear("gw/gw-a/pool/c9", container, state="hiber\u202enating", depth_m=4)
        robot = RobotInfo(id="rover-9", kind="zenoh")
        hear("robot/rover-9/state", robot, kind="tele\x07pathic", mode="sinking\x1b]0;x\x07", souls=[1])
        yield view


@pytest.mark.parametrize(
    "size", [(80, 24), pytest.param((160, 48), marks=pytest.mark.thorough)], ids=["80x24", "160x48"]
)
@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (("2",), ("? drea␛[31m[red]", "? s1 goto", "levi␛[5mtating")),
        (("2", "enter"), ("? drea␛[31m[red]", "? levi␛[5m")),
        (("3",), ("rover-9", "tele␇", "sinking␛]0;")),
        (("3", "end", "enter"), ("tele␇pathic", "sinking␛]0;x␇")),
        (("4",), ("c9", "? hiber�")),
    ],
    ids=["tasks", "task", "robots", "robot", "pool"],
)
async def test_unknown_states_are_shown(
    future: "FakeView", keys: tuple[str, ...], words: tuple[str, ...], size: tuple[int, int]
) -> None:
    """The row has the state's own word, and nothing in that word is obeyed or taken for markup."""
    app = SwiftbotApp(future, TuiConfig(refresh_hz=0.2))
    async with app.run_test(size=size) as pilot:
        for key in keys:
            await pilot.press(key)
            await app.workers.wait_for_complete()
            await pilot.pause()
        app.draw(force=True)
        await pilot.pause()
        text = characters(app)
        for word in words:
            assert word in text
        assert "\x1b" not in text
        # A state that is not known is not taken for an end.
        assert "2 active" in text
