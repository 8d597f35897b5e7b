"""Hands what a gateway knows to OpenTelemetry's and Prometheus' own packages, which send it on threads of their own.

The only module that imports them. A collector that does not answer holds nothing up: spans and log lines wait in
bounded queues, what is too much is dropped, and one log line a minute tells of it.
"""

import asyncio
import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Sequence
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar
from wsgiref.simple_server import WSGIServer

import structlog
from msgspec.structs import replace
from opentelemetry._logs import LogRecord, SeverityNumber
from opentelemetry.context import Context
from opentelemetry.exporter.otlp.proto.http._log_exporter import OTLPLogExporter
from opentelemetry.exporter.otlp.proto.http.metric_exporter import OTLPMetricExporter
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.exporter.prometheus import PrometheusMetricReader
from opentelemetry.metrics import CallbackOptions, Observation
from opentelemetry.sdk._logs import LoggerProvider
from opentelemetry.sdk._logs.export import BatchLogRecordProcessor
from opentelemetry.sdk.metrics import MeterProvider
from opentelemetry.sdk.metrics.export import MetricReader, PeriodicExportingMetricReader
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.sdk.trace.id_generator import IdGenerator
from opentelemetry.sdk.trace.sampling import ALWAYS_ON
from opentelemetry.trace import (
    NonRecordingSpan,
    SpanContext,
    SpanKind,
    Status,
    StatusCode,
    TraceFlags,
    set_span_in_context,
)
from prometheus_client import CollectorRegistry, start_http_server

from appliance.errors import ConfigError, SwiftbotError
from appliance.model import Failure, LogLine, RunEvent, RunEventKind, TaskRecord
from appliance.model.transitions import Transition
from appliance.observe.facts import Facts
from appliance.observe.figures import METRICS, RUN_S, START_S, Metric
from appliance.observe.settings import ObserveConfig
from appliance.observe.spans import CANCELLED, Span, Spans, of_call, span_of, trace_of
from appliance.pool.pool import Call

log = structlog.get_logger(__name__)

LOOK_S = 2.0
"""How often the gateway's facts are read anew: as often as it takes account of itself."""
TIMEOUT_S = 5.0
"""Of one request to the collector."""
CLOSE_S = 3.0
"""How long the last spans may take to be handed over when the gateway stops."""
QUIET_S = 60.0
"""Between two log lines about a collector that does not answer."""
MOST_TEXT = 500
"""Characters of a text in a span."""

_KINDS = {"internal": SpanKind.INTERNAL, "client": SpanKind.CLIENT, "server": SpanKind.SERVER}
_SEVERITIES = {
    "debug": SeverityNumber.DEBUG, "info": SeverityNumber.INFO, "warning": SeverityNumber.WARN,
    "error": SeverityNumber.ERROR, "exception": SeverityNumber.ERROR, "critical": SeverityNumber.FATAL,
}  # fmt: skip
P = ParamSpec("P")
T = TypeVar("T")


def _harmless(hear: "Callable[Concatenate[Observer, P], None]") -> "Callable[Concatenate[Observer, P], None]":
    """Have a defect in here be logged, once, and never be an error of the work that is told of."""

    @wraps(hear)
    def call(observer: "Observer", /, *args: P.args, **kwargs: P.kwargs) -> None:
        try:
            hear(observer, *args, **kwargs)
        except Exception:
            if observer.whole:
                observer.whole = False  # before it is logged: log lines come here too
                log.exception("telemetry has a defect: some of it is left out")

    return call


class _Ids(IdGenerator):
    """Gives the next span the IDs that it has by its names."""

    def __init__(self) -> None:
        self.trace = self.span = 0

    def generate_span_id(self) -> int:
        return self.span

    def generate_trace_id(self) -> int:
        return self.trace


class _Problems(logging.Handler):
    """What OpenTelemetry's packages complain of, as one log line of ours a minute at most."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._next_at = 0.0
        self._left_out = 0

    def emit(self, record: logging.LogRecord) -> None:
        if time.monotonic() < self._next_at:
            self._left_out += 1
            return
        left_out, self._left_out = self._left_out, 0
        self._next_at = time.monotonic() + QUIET_S
        log.warning(
            "telemetry is not delivered", reason=record.getMessage()[:300], left_out=left_out,
            remedy="see that the collector at observe.otlp answers",
        )  # fmt: skip


class Observer:
    """Tells monitoring systems of one gateway. `hear_…` and `timed` are for its event loop, and return at once.

    Args:
        config: what goes where.
        fleet: its name, of which the IDs of traces are made.
        gateway: its name.
        version: of the program.
        facts: reads the gateway's account of itself; what it raises is logged, and the facts before are told on.

    Raises:
        ConfigError: the port of the Prometheus endpoint is taken.
    """

    def __init__(
        self, config: ObserveConfig, *, fleet: str, gateway: str, version: str, facts: Callable[[], Awaitable[Facts]]
    ) -> None:
        self.whole = True
        """Whether no defect in here has left anything out."""
        self._config = config
        self._fleet = fleet
        self._read = facts
        self._facts: Facts | None = None
        self._ended = Counter[str]()
        self._spans = Spans()
        self._ids = _Ids()
        self._closers: list[Callable[[], object]] = []
        self._problems = _Problems()
        logging.getLogger("opentelemetry").addHandler(self._problems)
        logging.getLogger("opentelemetry").propagate = False
        resource = Resource.create({
            "service.name": "swiftbot", "service.namespace": fleet, "service.instance.id": gateway,
            "service.version": version,
        })  # fmt: skip
        wanted = config.signals if config.otlp else ()
        self._tracer = self._tracer_of(resource) if "traces" in wanted else None
        self._logger = self._logger_of(resource) if "logs" in wanted else None
        self._meter(resource, otlp="metrics" in wanted)

    # --- what goes where ----------------------------------------------------------------------------------------

    def _url(self, signal: str) -> str:
        return f"{self._config.otlp.rstrip('/')}/v1/{signal}"

    def _tracer_of(self, resource: Resource) -> Any:
        provider = TracerProvider(
            resource=resource, sampler=ALWAYS_ON, id_generator=self._ids, shutdown_on_exit=False
        )  # fmt: skip
        exporter = OTLPSpanExporter(endpoint=self._url("traces"), timeout=TIMEOUT_S)
        provider.add_span_processor(BatchSpanProcessor(exporter, schedule_delay_millis=2000))
        self._closers.append(provider.shutdown)
        return provider.get_tracer("swiftbot")

    def _logger_of(self, resource: Resource) -> Any:
        provider = LoggerProvider(resource=resource, shutdown_on_exit=False)
        exporter = OTLPLogExporter(endpoint=self._url("logs"), timeout=TIMEOUT_S)
        provider.add_log_record_processor(BatchLogRecordProcessor(exporter, schedule_delay_millis=2000))
        self._closers.append(provider.shutdown)
        return provider.get_logger("swiftbot")

    def _meter(self, resource: Resource, *, otlp: bool) -> None:
        readers: list[MetricReader] = []
        if otlp:
            exporter = OTLPMetricExporter(endpoint=self._url("metrics"), timeout=TIMEOUT_S)
            readers.append(
                PeriodicExportingMetricReader(exporter, export_interval_millis=self._config.interval_s * 1e3)
            )
        if self._config.prometheus:
            registry = CollectorRegistry()
            readers.append(
                PrometheusMetricReader(
                    scope_info_enabled=False, registry=registry,
                    resource_attribute_filter=lambda name: name == "service.instance.id",
                )
            )  # fmt: skip
            self._serve(registry)
        provider = MeterProvider(readers, resource, shutdown_on_exit=False)
        self._closers.append(provider.shutdown)
        meter = provider.get_meter("swiftbot")
        for metric in METRICS:
            make = meter.create_observable_gauge if metric.kind == "gauge" else meter.create_observable_counter
            make(metric.name, [self._reader(metric)], metric.unit, metric.help)
        self._starts = meter.create_histogram(
            "swiftbot.start.duration", "s", "From the order of a run to the first line of its handler",
            explicit_bucket_boundaries_advisory=START_S,
        )  # fmt: skip
        self._durations = meter.create_histogram(
            "swiftbot.run.duration", "s", "From the first line of a handler to its end",
            explicit_bucket_boundaries_advisory=RUN_S,
        )  # fmt: skip

    def _serve(self, registry: CollectorRegistry) -> None:
        port = self._config.prometheus
        server: WSGIServer
        try:
            server, _ = start_http_server(port, addr="127.0.0.1", registry=registry)
        except OSError as error:
            raise ConfigError(
                f"observe.prometheus: port {port} on 127.0.0.1: {error.strerror}", remedy="choose another port"
            ) from error
        self._closers += [server.shutdown, server.server_close]

    def _reader(self, metric: Metric) -> Callable[[CallbackOptions], Iterable[Observation]]:
        def read(_: CallbackOptions) -> list[Observation]:
            facts = self._facts  # of the event loop; not changed, so that any thread may read it
            return [Observation(value, labels) for value, labels in metric.read(facts)] if facts is not None else []

        return read

    async def run(self) -> None:
        """Read the gateway's facts again and again."""
        while True:
            try:
                self._facts = replace(await self._read(), ended=dict(self._ended))
            except Exception:  # a fact that cannot be read once must not silence the metrics for good
                log.exception("facts for metrics could not be read")
            await asyncio.sleep(LOOK_S)

    async def close(self) -> None:
        """Hand over what waits, for a few seconds at most."""
        loop, done = asyncio.get_running_loop(), asyncio.Event()

        def shut_down() -> None:
            for close in self._closers:
                close()
            with contextlib.suppress(RuntimeError):  # it took too long, and the loop is closed
                loop.call_soon_threadsafe(done.set)

        # Not one of the loop's own threads: those are waited for when the process ends.
        threading.Thread(target=shut_down, name="telemetry", daemon=True).start()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_S):
                await done.wait()
        logging.getLogger("opentelemetry").removeHandler(self._problems)

    # --- what is heard ------------------------------------------------------------------------------------------

    @_harmless
    def hear_transition(self, event: Transition) -> None:
        """Take what happened to a task that is coordinated here."""
        self._tell(self._spans.of_transition(event))

    @_harmless
    def hear_record(self, record: TaskRecord) -> None:
        """Take the record of such a task, as it has been written."""
        spans = self._spans.of_record(record)
        if spans:
            self._ended[str(record.state)] += 1
        self._tell(spans)

    @_harmless
    def hear_event(self, event: RunEvent) -> None:
        """Take what a run on this gateway has told."""
        if event.kind is RunEventKind.STARTED and event.startup_ms is not None:
            self._starts.record(event.startup_ms / 1e3, {"phase": str(event.phase or "unknown")})
        elif event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED) and event.duration_ms is not None:
            self._durations.record(event.duration_ms / 1e3, {"outcome": str(event.kind)})
        self._tell(self._spans.of_event(event))

    def timed(self, carry_out: Callable[[Call], Awaitable[T]]) -> Callable[[Call], Awaitable[T]]:
        """Return what carries handlers' calls out, with a span told of each."""

        async def call(wanted: Call) -> T:
            start_ns = time.time_ns()
            failure: Failure | None = CANCELLED
            try:
                found = await carry_out(wanted)
            except SwiftbotError as error:
                failure = Failure(code=error.code, message=error.message)
                raise
            else:
                failure = None
                return found
            finally:
                self._tell_call(wanted, start_ns, failure)

        return call

    @_harmless
    def hear_log(self, line: LogLine) -> None:
        """Take a log line of this gateway, from any thread."""
        if self._logger is None:
            return
        task, subtask, attempt = (str(line.fields.get(name, "")) for name in ("task", "subtask", "attempt"))
        part = f"{subtask}/{attempt}" if subtask and attempt else ""
        self._logger.emit(
            LogRecord(
                timestamp=line.at_ns,
                observed_timestamp=line.at_ns,
                context=self._below(task, part) if task else Context(),
                severity_text=line.level,
                severity_number=_SEVERITIES.get(line.level, SeverityNumber.INFO),
                body=line.event,
                attributes=dict(line.fields),
            )
        )

    @_harmless
    def _tell_call(self, call: Call, start_ns: int, failure: Failure | None) -> None:
        self._tell([of_call(call, start_ns=start_ns, end_ns=time.time_ns(), failure=failure)])

    def _tell(self, spans: Sequence[Span]) -> None:
        if self._tracer is None:
            return
        for span in spans:
            self._ids.trace = trace_of(self._fleet, span.task)
            self._ids.span = span_of(self._fleet, span.task, span.part)
            texts = {key: text[:MOST_TEXT] for key, text in span.texts.items()} if self._config.texts else {}
            made = self._tracer.start_span(
                span.name,
                context=self._below(span.task, span.parent) if span.parent is not None else Context(),
                kind=_KINDS[span.kind],
                attributes={"swiftbot.task": span.task, **span.attributes, **texts},
                start_time=span.start_ns,
            )
            if span.failure is not None:
                text = span.failure.message[:MOST_TEXT] if self._config.texts else span.failure.code
                made.set_attribute("error.type", span.failure.code)
                made.set_status(Status(StatusCode.ERROR, text))
            made.end(end_time=max(span.start_ns, span.end_ns))

    def _below(self, task: str, part: str) -> Context:
        """Return the context of a span of a task, which may be another gateway's."""
        parent = SpanContext(
            trace_of(self._fleet, task), span_of(self._fleet, task, part), is_remote=True,
            trace_flags=TraceFlags(TraceFlags.SAMPLED),
        )  # fmt: skip
        return set_span_in_context(NonRecordingSpan(parent), Context())
