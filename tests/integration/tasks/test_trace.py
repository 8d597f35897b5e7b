"""One task over two real gateways is one trace, read back from a collector; the endpoint counts it."""

import asyncio
import urllib.request
from pathlib import Path

import pytest
from fleets import PLAIN, fleet_in
from msgspec.structs import replace
from otlp import Collector, plain

from appliance.client import FleetClient
from appliance.model import TaskRecord, TaskRequest, TaskState
from appliance.observe.settings import ObserveConfig
from appliance.observe.spans import trace_of
from appliance.ports import free_port

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


async def done(client: FleetClient, request: TaskRequest) -> TaskRecord:
    """Submit a task and wait for its end."""
    await client.submit(request)
    async with asyncio.timeout(60):
        async for record in client.watch(request.id):
            last = record
    assert last.state is TaskState.SUCCEEDED, last.failure
    return last


async def test_a_task_over_two_gateways_is_one_trace(tmp_path: Path) -> None:
    """Instruction, plan, placement, start, robot command and result, with the coordinator's and the other's spans."""
    with Collector() as collector:
        base = replace(PLAIN, observe=ObserveConfig(otlp=collector.url, interval_s=1.0))
        async with (
            fleet_in(tmp_path, gateways=2, zenoh=1, sim_rate=8.0, base=base) as fleet,
            FleetClient(fleet.endpoint, operator="ann") as client,
        ):
            for number in range(20):  # which gateway coordinates follows from the ID
                request = TaskRequest(instruction="rover_1: go to dock 3", id=f"t-trace{number}", group=("gw-2",))
                record = await done(client, request)
                if record.coordinator == "gw-1":
                    break
            assert record.coordinator == "gw-1"
            wanted = f"{trace_of(fleet.fleet, record.id):032x}"
            async with asyncio.timeout(30):
                while True:
                    found = [(where, span) for where, span in collector.spans() if span.trace_id.hex() == wanted]
                    if {"task", "run", "command goto"} <= {span.name for _, span in found}:
                        break
                    await asyncio.sleep(0.1)
                while "swiftbot.start.duration" not in collector.metrics() or not collector.logs():
                    await asyncio.sleep(0.1)
    spans = {span.name: (where, span) for where, span in found}
    assert {name: where for name, (where, _) in spans.items() if name != "command state"} == {
        "task": "gw-1", "plan": "gw-1", "place": "gw-1", "attempt goto": "gw-1", "run": "gw-2", "command goto": "gw-2",
        next(name for name in spans if name.startswith("start ")): "gw-2",
    }  # fmt: skip
    parents = {span.span_id: span for _, span in found}
    chain = [spans["command goto"][1]]
    while chain[-1].parent_span_id:
        chain.append(parents[chain[-1].parent_span_id])
    assert [span.name for span in chain] == ["command goto", "run", "attempt goto", "task"]
    assert all(each.start_time_unix_nano >= chain[-1].start_time_unix_nano for _, each in found)
    assert plain(spans["command goto"][1].attributes)["swiftbot.command"].startswith(f"{record.id}/")
    assert any(record_.trace_id.hex() == wanted for record_ in collector.logs())


@pytest.mark.long
async def test_the_endpoint_of_a_gateway_counts_its_work(tmp_path: Path) -> None:
    """Prometheus finds the task, its start and the pool on the loopback."""
    port = free_port()
    base = replace(PLAIN, observe=ObserveConfig(prometheus=port))
    async with (
        fleet_in(tmp_path, gateways=1, zenoh=1, sim_rate=8.0, base=base) as fleet,
        FleetClient(fleet.endpoint, operator="ann") as client,
    ):
        await done(client, TaskRequest(instruction="rover_1: go to dock 3", id="t-count"))

        def scrape() -> str:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
                return answer.read().decode()

        async with asyncio.timeout(30):
            while 'swiftbot_tasks_ended_total{service_instance_id="gw-1",state="succeeded"} 1.0' not in (
                page := await asyncio.to_thread(scrape)
            ):
                await asyncio.sleep(0.2)
    assert 'swiftbot_run_duration_seconds_count{outcome="succeeded",service_instance_id="gw-1"} 1.0' in page
    assert "swiftbot_start_duration_seconds_bucket" in page
    assert 'swiftbot_pool_containers{image="base"' in page
    assert 'swiftbot_recorder_recording{recorder="' in page
    assert 'swiftbot_robots{online="yes",service_instance_id="gw-1"} 1.0' in page
