"""Work that goes wrong, on real gateways: silent runs, lost robots, alternatives, new plans, and the stream of it."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import aclosing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from fleets import INTERRUPTIBLE
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.llm.settings import LlmConfig
from appliance.model import Plan, RevisionKind, Subtask, SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig
from appliance.tasks.replay import replay
from appliance.tasks.settings import ReplanConfig, TasksConfig
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]

MANIFEST = """
id = "{name}"
domain = "coordination"
summary = "A test's own skill."
runs = "compute"
image = "base"
timeout_s = 120
retries = 1
{more}

[params.note]
type = "string"
required = false
"""
HUSHED = """
import time

def run(ctx):
    ctx.log("here I am", attempt_seen=ctx.attempt)
    if ctx.attempt == 1:
        time.sleep(100)
    return {"attempt": ctx.attempt}
"""
BREAKS = """
def run(ctx):
    raise ctx.Fail("broken on purpose", retryable=False)
"""
WORKS = """
import os
import time

def run(ctx):
    ctx.progress(0.5, "half of it")
    sum(range(2_000_000))
    return {"note": ctx.params.get("note", ""), "token": time.time_ns(), "pid": os.getpid()}
"""
LINGERS = """
import time

def run(ctx):
    until = time.monotonic() + 90
    while time.monotonic() < until:
        ctx.alive()
        time.sleep(0.1)
    return {}
"""
SKILLS = {
    "lingers": (LINGERS, "silent_s = 2"),
    "hushed": (HUSHED, "silent_s = 2"),
    "works": (WORKS, 'phrases = ["do"]'),
    "breaks": (BREAKS, 'phrases = ["go on"]'),
    "breaks_gently": (BREAKS, '[[alternatives]]\nskill = "works"\nparams = { note = "$note" }'),
}


def write_skills(folder: Path) -> Path:
    """Write the skills of these tests."""
    for name, (handler, more) in SKILLS.items():
        where = folder / name
        where.mkdir(parents=True)
        keys, _, tables = more.partition("[[")
        manifest = MANIFEST.format(name=name, more=keys)
        (where / "skill.toml").write_text(manifest + (f"\n[[{tables}\n" if tables else ""))
        (where / "handler.py").write_text(handler)
    return folder


def completion(plan: dict[str, Any]) -> bytes:
    """Return a chat completion as servers send it."""
    choice = {"index": 0, "message": {"role": "assistant", "content": json.dumps(plan)}, "finish_reason": "stop"}
    return json.dumps({"id": "c1", "object": "chat.completion", "choices": [choice], "usage": {}}).encode()


def subtask(name: str, skill: str, note: str, after: list[str]) -> dict[str, Any]:
    """A subtask as a model writes it."""
    return {"id": name, "skill": skill, "robot": None, "params": {"note": note}, "after": after}


FIRST = {
    "domain": "coordination",
    "subtasks": [subtask("s1", "works", "begin", []), subtask("s2", "breaks", "on", ["s1"])],
}
AGAIN = {
    "domain": "coordination",
    "subtasks": [subtask("a", "works", "begin", []), subtask("b", "works", "on", ["a"])],
}


class Upstream:
    """An OpenAI-compatible server that plans with a skill that breaks, and then without it."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        upstream = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["content-length"])))
                said = body["messages"][-1]["content"]
                upstream.asked.append(said)
                data = completion(AGAIN if "An earlier plan" in said else FIRST)
                self.send_response(200)
                self.send_header("content-length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._http.daemon_threads = True
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._http.server_address[1]}/v1"

    def close(self) -> None:
        """Stop."""
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()


@pytest.fixture
def upstream() -> Iterator[Upstream]:
    """Return a running stand-in for an upstream model."""
    running = Upstream()
    yield running
    running.close()


Up = Callable[..., Any]


@pytest.fixture
async def up(tmp_path: Path, upstream: Upstream) -> AsyncIterator[Up]:
    """Return a function that starts a fleet of two gateways; ended and cleaned up afterwards."""
    skills = write_skills(tmp_path / "skills")
    started: list[Path] = []

    async def start(*, zenoh: int = 0, **more: Any) -> FleetState:
        directory = tmp_path / "fleet"
        started.append(directory)
        base = GatewayConfig(
            id="base",
            skills=(str(skills),),
            llm=LlmConfig(tiers=("upstream", "rules"), upstream_url=upstream.url, upstream_model="big"),
            tasks=TasksConfig(check_s=0.5, replan=ReplanConfig(robot_wait_s=1.0)),
        )
        order = Order(
            fleet=f"r{os.getpid()}-{time.monotonic_ns() % 100000}",
            directory=directory,
            gateways=2,
            mavlink=0,
            zenoh=zenoh,
            base=base,
            **more,
        )
        return await local_fleet.up(order, progress=print, timeout_s=120.0)

    yield start
    for directory in started:
        if (directory / "fleet.json").exists():
            await local_fleet.down(directory, progress=print, volumes=True)


async def follow(client: FleetClient, task: str, *, until: Callable[[TaskRecord], bool]) -> TaskRecord:
    """Wait until a task's record is so."""
    async with asyncio.timeout(120), aclosing(client.watch(task, silence_s=0.3)) as changes:
        async for record in changes:
            if until(record):
                return record
    raise AssertionError(f"the task ended before that: {record.state} {record.failure}")


async def end(client: FleetClient, task: str) -> TaskRecord:
    """Wait for a task's end."""
    return await follow(client, task, until=lambda record: record.state.final)


def cli(state: FleetState, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run the command line against a fleet."""
    return subprocess.run(
        [sys.executable, "-m", "appliance.cli", *arguments, "--fleet", state.fleet, "--dir", state.directory],
        capture_output=True, text=True, timeout=90, check=False, env={**os.environ, "COLUMNS": "120"},
    )  # fmt: skip


def plan(*subtasks: Subtask) -> TaskRequest:
    """A task with its plan handed in."""
    return TaskRequest(instruction="try", plan=Plan(domain="coordination", subtasks=subtasks))


async def watched(state: FleetState, task: str) -> list[dict[str, Any]]:
    """All that is still known of a task that has ended, as `swiftbot task watch --json` prints it."""
    done = await asyncio.to_thread(cli, state, "task", "watch", task, "--json")
    assert done.returncode in (0, 1), done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


async def test_work_that_goes_wrong_is_found_and_mended(up: Up, upstream: Upstream) -> None:
    """A silent run is repeated elsewhere, a broken skill gives way to its alternative, a failed task is replanned.

    The stream has all of it from both gateways, before and after the end, and the log replays to the same records.
    """
    state = await up(pool=PoolConfig(floor={"base": 1}))
    async with FleetClient(state.endpoint) as client:
        accepted = await client.submit(plan(Subtask(id="s1", skill="hushed")))
        live = [line async for line in client.stream(accepted.id)]
        record = await end(client, accepted.id)
        assert record.state is TaskState.SUCCEEDED, record.failure
        first, second = record.of("s1").attempts
        assert first.failure is not None
        assert first.failure.code == "stuck"
        assert first.gateway != second.gateway
        assert second.cpu_ms is not None
        assert second.peak_mb is not None
        # Both attempts' own words are in the stream, from both gateways, in the order in which they were said.
        words = [(line.gateway, line.attempt) for line in live if line.text == "here I am"]
        assert words == [(first.gateway, 1), (second.gateway, 2)]
        assert any(line.kind == "monitor" and "stuck" in line.text for line in live)
        assert any(line.kind == "gateway" and line.fields.get("skill") == "hushed" for line in live)
        assert any(line.kind == "metrics" and "cpu_ms" in line.fields for line in live)
        afterwards = await watched(state, accepted.id)
        assert {line["gateway"] for line in afterwards if line.get("gateway")} == set(state.gateways)
        assert [line["attempt"] for line in afterwards if line.get("text") == "here I am"] == [1, 2]

        accepted = await client.submit(
            plan(
                Subtask(id="s1", skill="breaks_gently", params={"note": "kept"}),
                Subtask(id="s2", skill="works", after=("s1",)),
            )
        )
        record = await end(client, accepted.id)
        assert record.state is TaskState.SUCCEEDED, record.failure
        assert [each.subtask.skill for each in record.subtasks] == ["works", "works"]
        (revision,) = record.revisions
        assert (revision.kind, revision.dropped[0].skill) == (RevisionKind.SKILL, "breaks_gently")
        assert record.subtasks[0].result is not None
        assert record.subtasks[0].result["note"] == "kept"

        accepted = await client.submit(TaskRequest(instruction="do begin, then go on"))
        begun = await follow(
            client,
            accepted.id,
            until=lambda record: any(each.state is SubtaskState.SUCCEEDED for each in record.subtasks),
        )
        record = await end(client, accepted.id)
        assert record.state is TaskState.SUCCEEDED, record.failure
        assert record.of("s1") == replace(begun.of("s1")), "what was finished has changed"
        assert [each.subtask.params["note"] for each in record.subtasks] == ["begin", "on"]
        assert [each.subtask.skill for each in record.subtasks] == ["works", "works"]
        assert [each.kind for each in record.revisions] == [RevisionKind.PLAN]
        assert record.subtasks[1].subtask.after == ("s1",)
        assert "broken on purpose" in upstream.asked[-1]
        shown = await asyncio.to_thread(cli, state, "task", "show", record.id)
        assert "revision 1 (plan)" in shown.stdout, shown.stdout
        assert "broken on purpose" in shown.stdout
    await local_fleet.down(Path(state.directory), progress=print)
    reports = [replay(path) for path in sorted(Path(state.record_dir).glob("*.mcap"))]
    assert [each.differences for report in reports for each in report.tasks] == [()] * 3


async def test_whoever_watches_may_leave_and_the_task_goes_on(up: Up) -> None:
    """Ctrl-C ends `swiftbot task watch` with 0; a handler that only says that it is alive is never taken for stuck."""
    state = await up(pool=PoolConfig(floor={"base": 1}))
    async with FleetClient(state.endpoint) as client:
        accepted = await client.submit(plan(Subtask(id="s1", skill="lingers")))
        await follow(client, accepted.id, until=lambda record: _runs(record, "s1"))
        watching = await asyncio.create_subprocess_exec(
            *INTERRUPTIBLE, sys.executable, "-m", "appliance.cli", "task", "watch", accepted.id, "--json",
            "--fleet", state.fleet, "--dir", state.directory,
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert watching.stdout is not None
        async with asyncio.timeout(60):
            first = json.loads(await watching.stdout.readline())
        assert first["task"] == accepted.id
        await asyncio.sleep(5)  # longer than the skill promises to be silent at most
        watching.send_signal(signal.SIGINT)
        async with asyncio.timeout(60):
            _, said = await watching.communicate()
        assert watching.returncode == 0, said
        assert b"continues" in said
        record = await client.task(accepted.id)
        assert [each.number for each in record.of("s1").attempts] == [1]
        assert not record.of("s1").condition
        await client.cancel(accepted.id)
        assert (await end(client, accepted.id)).state is TaskState.CANCELLED


@pytest.mark.long
async def test_another_robot_takes_over_from_one_that_goes_offline(up: Up) -> None:
    """The robot that films is killed and keeps its ground: the other goes to the place, stands beside it, and films."""
    state = await up(zenoh=2, sim_rate=4.0, pool=PoolConfig(floor={"base": 1, "vision": 1}))
    async with FleetClient(state.endpoint) as client:
        accepted = await client.submit(
            plan(
                Subtask(id="s1", skill="goto", robot="any", params={"place": "goal 1"}),
                Subtask(
                    id="s2", skill="record_video", robot="any", params={"target": "aisle", "duration_s": 15.0},
                    after=("s1",),
                ),
            )
        )  # fmt: skip
        record = await follow(client, accepted.id, until=lambda record: _runs(record, "s2"))
        lost = record.of("s2").bound_robot
        process = next(each for each in state.processes if each.name == lost)
        os.kill(process.pid, signal.SIGKILL)
        record = await end(client, accepted.id)
        assert record.state is TaskState.SUCCEEDED, record.failure
        (revision,) = record.revisions
        assert revision.kind is RevisionKind.ROBOT
        again = record.of(revision.added[0])
        assert (again.subtask.skill, again.subtask.params) == ("goto", {"place": "goal 1"})
        film = record.of("s2")
        assert film.bound_robot == again.bound_robot != lost
        assert film.attempt >= 2
        assert record.of("s1").bound_robot == lost


def _runs(record: TaskRecord, name: str) -> bool:
    return any(each.subtask.id == name and each.state is SubtaskState.RUNNING for each in record.subtasks)
