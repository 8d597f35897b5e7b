"""The endpoint and the dashboard against Prometheus itself, Debian's package."""

import asyncio
import json
import os
import shutil
import time
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    Phase,
    RunEvent,
    RunEventKind,
    TaskRecord,
    TaskState,
)
from appliance.model.alerts import Alert, AlertLevel
from appliance.model.gateways import Deliveries, PlannerStatus, RecorderNote, TierFigures
from appliance.model.robot_api import LinkFacts
from appliance.model.transitions import Transition, TransitionKind
from appliance.observe.facts import Facts
from appliance.observe.observer import Observer
from appliance.observe.settings import ObserveConfig
from appliance.ports import free_port

pytestmark = [pytest.mark.anyio, pytest.mark.long]


def required(program: str) -> str:
    """Return a program's path. Without it the test is skipped with the reason, and fails where CI should have it."""
    found = shutil.which(os.environ.get(f"SWIFTBOT_{program.upper()}", program))
    if found is None:
        reason = f"no {program} here: scripts/setup.sh dev --with-prometheus, as in `make long`, brings it (19 MB)"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    return found


class Work:
    """A gateway that works: each look at its facts shows more than the one before."""

    def __init__(self) -> None:
        self.looks = 0

    async def facts(self) -> Facts:
        """What there is of everything."""
        self.looks += 1
        count = self.looks
        return Facts(
            status=GatewayStatus(
                id="gw-1", fleet="yard", cpu_percent=25.0, memory_mb=100.0, disk_free_mb=1024, disk_total_mb=2048,
                capacity=8, running=1, refused={"malformed status": count},
                recorders=(RecorderNote(id="recorder", state="recording", missed=count),),
                planner=PlannerStatus(tiers={"rules": TierFigures(asked=2 * count, failed=count)}),
                delivery=Deliveries(sent=count, failed=count),
            ),
            containers=(ContainerInfo(id="c1", gateway="gw-1", image="base", state=ContainerState.READY),),
            alerts=(Alert(id="a", kind="k", level=AlertLevel.CRITICAL, what="w", subject="robot", name="r"),),
            links=(LinkFacts(number=1, url="udp://0.0.0.0:14550", frames_in=count, refused={"crc": count}),),
            robots={"rover_1": True},
        )  # fmt: skip

    def one_task(self, observer: Observer) -> None:
        """Have a task begin, run and end."""
        now = time.time_ns()
        task = f"t-{now}"
        observer.hear_transition(
            Transition(task=task, sequence=1, kind=TransitionKind.ACCEPTED, at_ns=now, coordinator="gw-1")
        )
        for phase in Phase:
            started = RunEvent(
                task=task, subtask="s1", attempt=1, kind=RunEventKind.STARTED, phase=phase, startup_ms=3.0, at_ns=now
            )
            observer.hear_event(started)
            observer.hear_event(replace(started, kind=RunEventKind.SUCCEEDED, duration_ms=900.0))
        observer.hear_record(
            TaskRecord(id=task, instruction="go", state=TaskState.SUCCEEDED, created_ns=now, updated_ns=now)
        )


def get(url: str) -> Any:
    """Return what an address answers; None while nothing listens."""
    try:
        with urllib.request.urlopen(url, timeout=10) as answer:  # noqa: S310 - http, of this machine
            return answer.read()
    except OSError:
        return None


async def test_each_query_of_the_dashboard_has_an_answer(tmp_path: Path, project_root: Path) -> None:
    """Prometheus scrapes the endpoint, its own linter finds nothing, and each panel would show figures."""
    prometheus, promtool = required("prometheus"), required("promtool")
    endpoint, port = free_port(), free_port()
    (tmp_path / "prometheus.yml").write_text(
        "scrape_configs: [{job_name: swiftbot, scrape_interval: 1s, scrape_timeout: 1s, "
        f"static_configs: [{{targets: ['127.0.0.1:{endpoint}']}}]}}]\n"
    )
    board = json.loads((project_root / "docs/examples/grafana-dashboard.json").read_text())
    queries = {target["expr"] for panel in board["panels"] for target in panel.get("targets", ())}
    work = Work()
    observer = Observer(ObserveConfig(prometheus=endpoint), fleet="yard", gateway="gw-1", version="1", facts=work.facts)
    looking = asyncio.create_task(observer.run())
    with (tmp_path / "log").open("wb") as log:
        process = await asyncio.create_subprocess_exec(
            prometheus, f"--config.file={tmp_path}/prometheus.yml", f"--storage.tsdb.path={tmp_path}/data",
            f"--web.listen-address=127.0.0.1:{port}", stdout=log, stderr=log,
        )  # fmt: skip
    try:
        unanswered = dict.fromkeys(queries, "")
        async with asyncio.timeout(120):
            while unanswered:
                work.one_task(observer)
                await asyncio.sleep(0.5)
                for query in tuple(unanswered):
                    where = f"http://127.0.0.1:{port}/api/v1/query?{urllib.parse.urlencode({'query': query})}"
                    answer = await asyncio.to_thread(get, where)
                    if answer is None:
                        assert process.returncode is None, (tmp_path / "log").read_text()[-2000:]
                        continue
                    found = json.loads(answer)
                    assert found["status"] == "success", (query, found)
                    if any(row["value"][1] != "NaN" for row in found["data"]["result"]):
                        del unanswered[query]
        page = await asyncio.to_thread(get, f"http://127.0.0.1:{endpoint}/metrics")
        linter = await asyncio.create_subprocess_exec(
            promtool, "check", "metrics", stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )  # fmt: skip
        told, _ = await linter.communicate(page)
        assert (linter.returncode, told.decode()) == (0, "")
    finally:
        process.terminate()
        await process.wait()
        looking.cancel()
        await observer.close()
