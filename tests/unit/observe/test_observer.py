"""What leaves a gateway: to a collector that reads the official messages, and on the Prometheus endpoint."""

import asyncio
import json
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import structlog
from otlp import Collector, plain

from appliance import logs
from appliance.config import GatewayConfig, check
from appliance.errors import ConfigError, RobotError
from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    LogLine,
    Phase,
    RunEvent,
    RunEventKind,
    TaskRecord,
    TaskState,
    Word,
)
from appliance.model.alerts import Alert, AlertLevel
from appliance.model.gateways import Deliveries, PlannerStatus, RecorderNote, TierFigures
from appliance.model.robot_api import LinkFacts
from appliance.model.transitions import Transition, TransitionKind
from appliance.observe.facts import Facts
from appliance.observe.figures import METRICS
from appliance.observe.observer import Observer
from appliance.observe.settings import ObserveConfig
from appliance.observe.spans import span_of, trace_of
from appliance.ports import free_port

DASHBOARD = Path(__file__).parents[3] / "docs" / "examples" / "grafana-dashboard.json"
FACTS = Facts(
    status=GatewayStatus(
        id="gw-1", fleet="yard", cpu_percent=25.0, memory_mb=100.0, disk_free_mb=1024, disk_total_mb=2048, capacity=8,
        running=2, queue=3, refused={"unauthorized gw/a/rpc/b": 2, "unauthorized gw/a/rpc/c": 1},
        recorders=(RecorderNote(id="recorder", state="recording", missed=7),),
        planner=PlannerStatus(tiers={"rules": TierFigures(asked=5, failed=1)}),
        delivery=Deliveries(sent=4, failed=1),
    ),
    containers=(ContainerInfo(id="c1", gateway="gw-1", image="base", state=ContainerState.READY),),
    alerts=(
        Alert(id="a", kind="k", level=AlertLevel.CRITICAL, what="w", subject="robot", name="r"),
        Alert(id="b", kind="k", level=AlertLevel.WARNING, what="w", subject="robot", name="r", acked=Word(by="ann")),
    ),
    links=(LinkFacts(number=1, url="udp://0.0.0.0:14550", frames_in=10, frames_out=4, refused={"crc": 2}),),
    robots={"rover_1": True, "rover_2": False, "rover_3": True},
    gateways=2,
    tasks={"running": 1, "needs approval": 2},
)  # fmt: skip
COMMON: dict[str, Any] = {"task": "t-1", "subtask": "s1", "attempt": 1, "gateway": "gw-1"}


@pytest.fixture(autouse=True)
def _nothing_goes_on() -> Iterator[None]:
    """Exporters that retry draw random numbers in threads, which would disturb the properties of other tests."""
    yield
    for thread in threading.enumerate():
        if thread.name == "telemetry":
            thread.join()


def observer(config: ObserveConfig, facts: Facts = FACTS) -> Observer:
    """Return one of the gateway gw-1."""

    async def read() -> Facts:
        return facts

    return Observer(config, fleet="yard", gateway="gw-1", version="1", facts=read)


async def a_task(seen: Observer, *, instruction: str = "rover_1: go") -> None:
    """Have it hear of a task from beginning to end, with a command to a robot and a log line."""
    now = time.time_ns()

    def moved(kind: TransitionKind, **more: Any) -> Transition:
        return Transition(task="t-1", sequence=1, kind=kind, at_ns=now, coordinator="gw-1", **more)

    async def carry_out(call: Any) -> str:
        if call.number > 1:
            raise RobotError("the motor is hot")
        return "done"

    seen.hear_transition(moved(TransitionKind.ACCEPTED))
    seen.hear_transition(moved(TransitionKind.PLANNED))
    seen.hear_transition(moved(TransitionKind.DISPATCHED, subtask="s1", attempt=1, gateway="gw-1"))
    seen.hear_event(RunEvent(**COMMON, kind=RunEventKind.STARTED, phase=Phase.LOCAL_WARM, startup_ms=3.0, at_ns=now))
    run = SimpleNamespace(task="t-1", subtask="s1", attempt=1, robot="rover_1")
    timed = seen.timed(carry_out)
    for number in (1, 2):
        call: Any = SimpleNamespace(run=run, number=number, name="command", args={"verb": "goto"})
        try:
            assert await timed(call) == "done"
        except RobotError:
            assert number == 2
    fields = {"task": "t-1", "subtask": "s1", "attempt": 1}
    seen.hear_log(LogLine(at_ns=now, level="warning", source="gw-1", event="the motor is warm", fields=fields))
    seen.hear_log(LogLine(at_ns=now, level="info", source="gw-1", event="about no task"))
    seen.hear_event(RunEvent(**COMMON, kind=RunEventKind.SUCCEEDED, duration_ms=1500.0, at_ns=now))
    seen.hear_transition(moved(TransitionKind.SUCCEEDED, subtask="s1", attempt=1))
    seen.hear_record(
        TaskRecord(id="t-1", instruction=instruction, state=TaskState.SUCCEEDED, created_ns=now, updated_ns=now)
    )


def observed(config: ObserveConfig, *, facts_s: float = 0.0) -> None:
    """Run an observer over a task and close it."""

    async def run() -> None:
        seen = observer(config)
        reading = asyncio.create_task(seen.run())
        await asyncio.sleep(facts_s)
        await a_task(seen)
        await seen.close()
        reading.cancel()

    asyncio.run(run())


def test_a_collector_gets_a_task_as_one_trace() -> None:
    """Parents by the IDs that their names give, kinds and errors as the protocol has them, log lines in the trace."""
    with Collector() as collector:
        observed(ObserveConfig(otlp=collector.url))
        spans = {span.name: span for _, span in collector.spans()}
        names = [span.name for _, span in collector.spans()]
        logs = collector.logs()
    assert sorted(names) == [
        "attempt", "command goto", "command goto", "place", "plan", "run", "start local warm", "task",
    ]  # fmt: skip
    assert {span.trace_id.hex() for span in spans.values()} == {f"{trace_of('yard', 't-1'):032x}"}
    assert spans["task"].parent_span_id == b""
    assert spans["attempt"].parent_span_id == spans["plan"].parent_span_id == spans["task"].span_id
    assert spans["run"].parent_span_id == spans["place"].parent_span_id == spans["attempt"].span_id
    assert spans["command goto"].parent_span_id == spans["run"].span_id
    assert spans["command goto"].status.code == 2
    assert plain(spans["command goto"].attributes)["error.type"] == "robot"
    about, other = logs
    assert (about.body.string_value, about.severity_text) == ("the motor is warm", "warning")
    assert about.trace_id == spans["task"].trace_id
    assert about.span_id.hex() == f"{span_of('yard', 't-1', 's1/1'):016x}"
    assert other.trace_id == b""


@pytest.mark.parametrize("texts", [False, True])
def test_texts_leave_only_where_that_is_wanted(texts: bool) -> None:
    """Instructions and failures may say what is nobody's business elsewhere."""
    with Collector() as collector:
        observed(ObserveConfig(otlp=collector.url, texts=texts, signals=("traces",)))
        shown = str(collector.requests)
    assert ("rover_1: go" in shown) is texts
    assert ("the motor is hot" in shown) is texts


def test_a_collector_gets_the_metrics_with_units() -> None:
    """All of the table and both histograms; only what is in `signals` is sent."""
    with Collector() as collector:
        observed(ObserveConfig(otlp=collector.url, signals=("metrics",)), facts_s=0.1)
        found = collector.metrics()
        assert collector.spans() == collector.logs() == []
    assert set(found) == {metric.name for metric in METRICS} | {"swiftbot.start.duration", "swiftbot.run.duration"}
    assert found["swiftbot.disk.free"].unit == "By"
    assert found["swiftbot.disk.free"].gauge.data_points[0].as_int == 2**30
    (point,) = found["swiftbot.start.duration"].histogram.data_points
    assert (point.count, point.sum) == (1, 0.003)


@pytest.mark.parametrize("code", [503, 400])
def test_a_collector_that_refuses_holds_nothing_up(
    code: int, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told once, with what to do; work goes on and the gateway stops in time."""
    monkeypatch.setattr("appliance.observe.observer.CLOSE_S", 0.5)
    monkeypatch.setattr("appliance.observe.observer.TIMEOUT_S", 1.5)
    with Collector(refuses=code) as collector:
        observed(ObserveConfig(otlp=collector.url))
    said = capfd.readouterr()
    assert (said.out + said.err).count("telemetry is not delivered") == 1
    assert "observe.otlp" in said.out + said.err
    observed(ObserveConfig(otlp="http://127.0.0.1:1"))


def test_a_defect_of_telemetry_is_no_error_of_the_work(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Tasks go on, a robot's answer reaches its handler, and the log tells of it once."""

    def broken(*_: Any, **__: Any) -> None:
        raise ValueError("a defect")

    async def run() -> None:
        with Collector() as collector:
            seen = observer(ObserveConfig(otlp=collector.url))
            monkeypatch.setattr(seen, "_tracer", SimpleNamespace(start_span=broken))
            monkeypatch.setattr(seen, "_logger", SimpleNamespace(emit=broken))
            logs.publish_to(seen.hear_log)  # as a gateway does: what is logged comes back
            try:
                await a_task(seen)
            finally:
                logs.publish_to(None)
            await seen.close()

    before = structlog.get_config()
    logs.configure(style="text")
    try:
        asyncio.run(run())
    finally:
        structlog.configure(**before)
    said = capfd.readouterr()
    assert (said.out + said.err).count("telemetry has a defect") == 1


def scraped(port: int) -> str:
    """Return what the endpoint shows."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        return answer.read().decode()


@pytest.fixture(scope="module")
def page() -> str:
    """Return the endpoint's page after a task."""
    port = free_port()

    async def run() -> str:
        seen = observer(ObserveConfig(prometheus=port))
        reading = asyncio.create_task(seen.run())
        await asyncio.sleep(0)
        await a_task(seen)
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
        again = asyncio.create_task(seen.run())
        await asyncio.sleep(0.1)
        found = await asyncio.to_thread(scraped, port)
        again.cancel()
        await seen.close()
        return found

    return asyncio.run(run())


def test_prometheus_finds_names_with_units(page: str) -> None:
    """Base units in the names, `_total` on counters, a bounded set of labels, the gateway on each."""
    at = 'service_instance_id="gw-1"'
    for line in (
        f"swiftbot_disk_free_bytes{{{at}}} 1.073741824e+09",
        f'swiftbot_tasks{{{at},state="needs approval"}} 2.0',
        f'swiftbot_tasks_ended_total{{{at},state="succeeded"}} 1.0',
        f'swiftbot_start_duration_seconds_bucket{{le="0.005",phase="local warm",{at}}} 1.0',
        f'swiftbot_run_duration_seconds_sum{{outcome="succeeded",{at}}} 1.5',
        f'swiftbot_pool_containers{{image="base",{at},state="ready"}} 1.0',
        f'swiftbot_recorder_missed_total{{recorder="recorder",{at}}} 7.0',
        f'swiftbot_link_frames_total{{direction="in",link="udp://0.0.0.0:14550",{at}}} 10.0',
        f'swiftbot_alerts{{acknowledged="no",level="critical",{at}}} 1.0',
        f'swiftbot_refused_total{{kind="unauthorized",{at}}} 3.0',
        f'swiftbot_robots{{online="yes",{at}}} 2.0',
    ):
        assert line in page, line
    families = dict(re.findall(r"# TYPE (\S+) (\S+)", page))
    assert all(name.endswith("_total") == (kind == "counter") for name, kind in families.items())
    assert {name for name in families if not name.startswith("swiftbot_")} == {"target_info"}


def test_each_query_of_the_dashboard_names_metrics_and_labels_that_exist(page: str) -> None:
    """A renamed metric or label breaks this, not somebody's dashboard."""
    shown: dict[str, set[str]] = {}
    for name, labels in re.findall(r"^(\w+)\{(.*)\} ", page, re.MULTILINE):
        shown.setdefault(name, set()).update(re.findall(r'(\w+)="', labels))
    queries = [
        target["expr"] for panel in json.loads(DASHBOARD.read_text())["panels"] for target in panel.get("targets", ())
    ]
    assert len(queries) > 10
    for query in queries:
        named = re.findall(r"(swiftbot_\w+)(?:\{([^}]*)\})?", query)
        assert named, query
        for name, matchers in named:
            assert name in shown, f"{query}: the endpoint has no {name}"
            wanted = set(re.findall(r"(\w+)\s*(?:=|!)", matchers))
            by = {each.strip() for group in re.findall(r"by \(([^)]*)\)", query) for each in group.split(",")}
            assert wanted | by <= shown[name] | {"instance"}, query


def test_a_port_that_is_taken_is_a_clear_error() -> None:
    """The gateway does not start without what it was told to offer."""
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(ConfigError, match=r"observe\.prometheus: port") as refused,
    ):
        observer(ObserveConfig(prometheus=taken.getsockname()[1]))
    assert "another port" in refused.value.remedy


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"otlp": "127.0.0.1:4318"}, "observe.otlp"), ({"otlp": "http://"}, "observe.otlp"),
        ({"otlp": "grpc://x:4317"}, "observe.otlp"), ({"signals": ("spans",)}, "observe.signals"),
    ],
)  # fmt: skip
def test_wrong_settings_name_their_key(given: dict[str, Any], told: str) -> None:
    """Before anything starts."""
    with pytest.raises(ConfigError, match=told):
        check(GatewayConfig(id="gw-1", observe=ObserveConfig(**given)), "gateway.toml")


def test_what_is_off_is_not_loaded() -> None:
    """Neither a gateway nor the command line imports a package of this while it is off, so that they start as fast."""
    code = (
        "import sys, appliance.gateway, appliance.cli; "
        "print([name for name in sys.modules if name.split('.')[0] in ('opentelemetry', 'prometheus_client', 'mcp', "
        "'starlette', 'uvicorn', 'pydantic')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
