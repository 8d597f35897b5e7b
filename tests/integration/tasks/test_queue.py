"""Tasks that wait for their turn on real gateways: none is lost or done twice, also when their coordinator dies."""

import asyncio
import json
import os
import signal
import sys
from collections import Counter
from pathlib import Path

import pytest
from fleets import PLAIN, fleet_in
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.errors import SwiftbotError
from appliance.model import TaskState, keyspace
from appliance.model.messages import Notice
from appliance.model.task_api import TasksAsk
from appliance.tasks.settings import TasksConfig

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]

TASKS = 30


async def test_a_file_of_tasks_outlives_a_gateway(tmp_path: Path) -> None:
    """Thirty tasks at gateways that work on two at once; one is killed while they wait: all end, each once."""
    base = replace(PLAIN, tasks=TasksConfig(max_tasks=2))
    file = tmp_path / "tasks.jsonl"
    lines = [json.dumps(f"notify ops: number {number}") for number in range(TASKS)]
    file.write_text("\n".join([*lines[:10], "{broken", *lines[10:]]))
    async with fleet_in(tmp_path, gateways=3, zenoh=0, base=base) as state, FleetClient(state.endpoint) as client:
        notices = Counter[str]()

        def take(_: str, notice: Notice | None) -> None:
            if notice is not None and notice.text.startswith("number"):
                notices[notice.text] += 1

        client.plane.session.subscribe_typed(keyspace.NOTICE, take)
        arguments = ("submit", "--file", str(file), "--id", "night", "--json", "--dir", state.directory)
        submitting = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "appliance.cli", *arguments, stdout=-1, stderr=-1
        )
        out, said = await submitting.communicate()
        assert submitting.returncode == 1
        told = json.loads(out)
        assert (told["accepted"], [each["line"] for each in told["problems"]]) == (TASKS, [11])
        assert f"{file}:11: no task" in said.decode()
        victim = next(each for each in state.processes if each.name == "gw-2")
        os.kill(victim.pid, signal.SIGKILL)
        ended: dict[str, TaskState] = {}
        async with asyncio.timeout(200):
            while len(ended) < TASKS:
                await asyncio.sleep(0.5)
                try:
                    found = await client.tasks(200, wanted=TasksAsk(text="night-"))
                except SwiftbotError:
                    continue  # the ring settles
                ended |= {each.id: each.state for each in found.tasks if each.state.final}
        assert Counter(ended.values()) == {TaskState.SUCCEEDED: TASKS}
        assert set(ended) == {f"night-{number + 1}" for number in range(TASKS + 1)} - {"night-11"}
        assert all(count == 1 for count in notices.values())
        waiting = [each.tasks_waiting for name, each in client.plane.registry.gateways.items() if name != "gw-2"]
        assert waiting == [0, 0]
