"""Robots that others wrote, over real Zenoh: those that do not keep to the contract end with a reason, soon."""

import asyncio
import json
import signal
import sys
import threading
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
from fleets import INTERRUPTIBLE
from robots_process import Process, gateway_process, open_zenoh, swiftbot

from appliance.connection import FleetState
from appliance.model import (
    Failure,
    Plan,
    Pose,
    RobotCommand,
    RobotInfo,
    RobotReply,
    Subtask,
    TaskRecord,
    TaskRequest,
    TaskState,
    encode,
)

pytestmark = [pytest.mark.anyio, pytest.mark.podman]

SLOW_S = 14.0
"""What a slow robot takes for a `goto`: longer than a question is waited for."""


class Program:
    """A robot's program, as its author wrote it: `obey` answers a command, or not; one after the other."""

    def __init__(self, fleet: FleetState, obey: Callable[["Program", RobotCommand, Any], None]) -> None:
        self.done: list[RobotCommand] = []
        self.asked: list[tuple[float, RobotCommand]] = []
        self.pose = Pose(x=4.0, y=4.0)
        self._obey = obey
        self._session = open_zenoh(fleet)
        self._key = f"swiftbot/{fleet.fleet}/robot/cart_1"
        self._token = self._session.liveliness().declare_token(f"{self._key}/alive")
        self._served = self._session.declare_queryable(f"{self._key}/command", self._take)
        self._ended = threading.Event()
        self._telling = threading.Thread(target=self._tell)
        self._telling.start()

    def _take(self, query: Any) -> None:
        try:
            command = msgspec.json.decode(query.payload.to_bytes(), type=RobotCommand)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return  # dropped, as by many a first program
        self.asked.append((time.monotonic(), command))
        if command.verb == "state":
            self.reply(query, command, pose={"x": self.pose.x, "y": self.pose.y, "z": 0.0})
        else:
            self._obey(self, command, query)

    def reply(self, query: Any, command: RobotCommand, failure: Failure | None = None, **result: Any) -> None:
        """Answer."""
        query.reply(str(query.key_expr), encode(RobotReply(id=command.id, result=result, failure=failure)))

    def go(self, command: RobotCommand) -> None:
        """Do it."""
        self.done.append(command)
        way = command.args.get("waypoints")
        if way:
            self.pose = Pose(x=way[-1]["x"], y=way[-1]["y"])

    def ends(self, seconds: float) -> bool:
        """Wait; whether the program ends meanwhile."""
        return self._ended.wait(seconds)

    def _tell(self) -> None:
        verbs = ("goto", "hold", "state", "stop")
        while not self._ended.wait(0.2):
            info = RobotInfo(id="cart_1", kind="zenoh", uses=("base",), verbs=verbs, pose=self.pose, speaker="1-a")
            self._session.put(f"{self._key}/state", encode(info), encoding="application/json")

    def close(self) -> None:
        """End the program."""
        self._ended.set()
        self._telling.join()
        self._token.undeclare()
        self._served.undeclare()
        self._session.close()


def mute(program: Program, command: RobotCommand, query: Any) -> None:
    """Drops what it is ordered."""


KEPT: list[Any] = []
"""Questions that are neither answered nor dropped."""


def holding(program: Program, command: RobotCommand, query: Any) -> None:
    """Takes an order, and never answers."""
    KEPT.append(query)


def forgetful(program: Program, command: RobotCommand, query: Any) -> None:
    """Does what it is ordered as often as it is asked, and answers when it is done."""
    if command.verb == "stop" or not program.ends(SLOW_S if command.verb == "goto" else 0.0):
        program.go(command)
        program.reply(query, command)


@asynccontextmanager
async def running(it: Process, obey: Callable[[Program, RobotCommand, Any], None]) -> AsyncGenerator[Program]:
    """Run a robot's program until it is in the list, and end it."""
    program = await asyncio.to_thread(Program, it.fleet, obey)
    try:
        await it.until(lambda: "cart_1" in it.robots() and it.robots()["cart_1"].online)
        yield program
    finally:
        KEPT.clear()
        await asyncio.to_thread(program.close)


async def sent(it: Process) -> tuple[TaskRecord, float]:
    """Have cart_1 go somewhere; return the task when it has ended, and how long that took, seconds."""
    plan = Plan(
        domain="navigation", subtasks=(Subtask(id="s1", skill="goto", robot="cart_1", params={"place": "dock 1"}),)
    )
    began = time.monotonic()
    task = await it.client.submit(TaskRequest(id=f"t-{time.time_ns()}", instruction="cart_1 to dock 1", plan=plan))
    async with asyncio.timeout(100):
        while task.state not in (TaskState.SUCCEEDED, TaskState.FAILED, TaskState.CANCELLED):
            await asyncio.sleep(0.2)
            task = await it.client.task(task.id)
    return task, time.monotonic() - began


@pytest.mark.long
async def test_tasks_of_robots_that_do_not_answer_fail_with_the_reason(tmp_path: Path) -> None:
    """One that drops its orders, and one that takes them: asked ever less often, given up, and told which and why."""
    async with gateway_process(tmp_path) as it:
        async with running(it, mute) as robot:
            task, _ = await sent(it)
            assert task.state is TaskState.FAILED
            assert task.failure is not None
            assert "robot cart_1 did not answer goto for 8 s" in task.failure.message
            assert "swiftbot robots check cart_1" in task.failure.remedy
            orders = [each for _, each in robot.asked if each.verb == "goto"]
            assert 3 <= len(orders) < 12
            assert len({each.id for each in orders}) == 1
        await it.until(lambda: not it.robots()["cart_1"].online)
        async with running(it, holding) as robot:
            task, _ = await sent(it)
            assert task.state is TaskState.FAILED
            assert task.failure is not None
            assert "robot cart_1 did not answer goto for 36 s (asked 2 times)" in task.failure.message
            assert len([each for _, each in robot.asked if each.verb == "goto"]) == 2
            assert robot.asked[-1][1].verb == "stop"


@pytest.mark.long
async def test_a_robot_that_keeps_no_replies_is_found_out(tmp_path: Path) -> None:
    """Its task fails with the reason when it does again what it has done, instead of asking it for ever."""
    async with gateway_process(tmp_path) as it, running(it, forgetful) as robot:
        task, _ = await sent(it)
        assert task.state is TaskState.FAILED
        assert task.failure is not None
        assert (
            "carries goto out again when it is asked again: it keeps no replies by command id" in task.failure.message
        )
        assert "docs/robot-contract.md" in task.failure.remedy
        assert len(task.subtasks[0].attempts) == 1
        assert len({each.id for each in robot.done if each.verb == "goto"}) == 1


@pytest.mark.long
async def test_the_check_passes_a_robot_that_keeps_to_the_contract(tmp_path: Path) -> None:
    """The simulated rover, with `--moves` too: each check is shown, nothing is skipped, and it moves only then."""
    async with gateway_process(tmp_path, zenoh=1) as it:
        await it.until(lambda: "rover_1" in it.robots() and it.robots()["rover_1"].online)
        before = it.robots()["rover_1"].pose
        code, printed = await swiftbot(it.fleet, "robots", "check", "rover_1")
        assert code == 0, printed
        assert "rover_1 conforms to the contract" in printed
        assert printed.count("✔") == 12
        assert "–" not in printed
        assert it.robots()["rover_1"].pose == before
        code, printed = await swiftbot(it.fleet, "robots", "check", "rover_1", "--moves", "--json")
        assert code == 0, printed
        report = json.loads(printed[printed.index("\n{") if "\n{" in printed else 0 :])
        assert report["passed"]
        assert "goto" in [each["check"] for each in report["checks"]]
        lease = await it.client.take_over("rover_1", lease_s=5.0)  # it has been given back
        await it.client.give_back(lease)


@pytest.mark.long
async def test_the_check_names_what_a_robot_does_not_do(tmp_path: Path) -> None:
    """Exit code 1 and a remedy for a forgetful one and a mute one; Ctrl-C ends it, and the robot is free again."""
    async with gateway_process(tmp_path) as it:
        async with running(it, forgetful):
            code, printed = await swiftbot(it.fleet, "robots", "check", "cart_1")
            assert code == 1, printed
            assert "✘ unknown verb: a verb that it does not have is answered as done" in printed
            assert "✘ old attempt" in printed
            assert "hint:" in printed
            assert "fails" in printed
        await it.until(lambda: not it.robots()["cart_1"].online)
        async with running(it, mute) as robot:
            code, printed = await swiftbot(it.fleet, "robots", "check", "cart_1")
            assert code == 1, printed
            assert "✘ hold: hold is not done" in printed
            robot.asked.clear()
            process = await asyncio.create_subprocess_exec(
                *INTERRUPTIBLE, sys.executable, "-m", "appliance.cli", "robots", "check", "cart_1",
                "--dir", it.fleet.directory, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
            )  # fmt: skip
            await it.until(lambda: any(each.verb == "hold" and each.lease for _, each in robot.asked))
            process.send_signal(signal.SIGINT)
            await process.communicate()
            assert process.returncode == 130
            await it.client.give_back(await it.client.take_over("cart_1", lease_s=5.0))
        code, printed = await swiftbot(it.fleet, "robots", "check", "nobody_1")
        assert code == 4
        assert "no robot 'nobody_1'" in printed


@pytest.mark.long
async def test_the_example_of_the_contract_keeps_to_it(tmp_path: Path) -> None:
    """docs/examples/robots/minimal_robot.py passes the check, with `--moves`, and does a task that takes long."""
    example = Path(__file__).resolve().parents[3] / "docs/examples/robots/minimal_robot.py"
    async with gateway_process(tmp_path) as it:
        process = await asyncio.create_subprocess_exec(
            sys.executable, str(example), it.fleet.fleet, "cart_1", it.fleet.endpoints[0],
            stdout=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            await it.until(lambda: "cart_1" in it.robots() and it.robots()["cart_1"].online)
            code, printed = await swiftbot(it.fleet, "robots", "check", "cart_1", "--moves")
            assert code == 0, printed
            assert printed.count("✔") == 13
            task, took_s = await sent(it)
            assert task.state is TaskState.SUCCEEDED, task.failure
            assert took_s > SLOW_S  # asked again meanwhile
        finally:
            process.terminate()
            await process.wait()
