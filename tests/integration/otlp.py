"""A collector for tests: takes OTLP over HTTP on the loopback, as the official protobuf messages read it."""

import gzip
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any

from opentelemetry.proto.collector.logs.v1.logs_service_pb2 import ExportLogsServiceRequest
from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import ExportMetricsServiceRequest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

REQUESTS = {
    "/v1/traces": ExportTraceServiceRequest,
    "/v1/metrics": ExportMetricsServiceRequest,
    "/v1/logs": ExportLogsServiceRequest,
}


def plain(attributes: Any) -> dict[str, Any]:
    """Return attributes as a dictionary."""
    return {each.key: getattr(each.value, each.value.WhichOneof("value")) for each in attributes}


class Collector:
    """Use it as a context manager; `url` is its base address.

    Args:
        refuses: answer with this code, and keep nothing; 0: take all.
    """

    def __init__(self, refuses: int = 0) -> None:
        self.requests: list[Any] = []
        collector = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                if self.headers.get("Content-Encoding") == "gzip":
                    body = gzip.decompress(body)
                if not refuses:
                    collector.requests.append(REQUESTS[self.path].FromString(body))
                self.send_response(refuses or 200)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self) -> "Collector":
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()

    def spans(self) -> list[tuple[str, Any]]:
        """Return the spans that have come, each with the gateway that told it."""
        return [
            (plain(each.resource.attributes)["service.instance.id"], span)
            for request in tuple(self.requests)
            if isinstance(request, ExportTraceServiceRequest)
            for each in request.resource_spans
            for scope in each.scope_spans
            for span in scope.spans
        ]

    def logs(self) -> list[Any]:
        """Return the log records that have come."""
        return [
            record
            for request in tuple(self.requests)
            if isinstance(request, ExportLogsServiceRequest)
            for each in request.resource_logs
            for scope in each.scope_logs
            for record in scope.log_records
        ]

    def metrics(self) -> dict[str, Any]:
        """Return the metrics that have come, the last of each name."""
        return {
            metric.name: metric
            for request in tuple(self.requests)
            if isinstance(request, ExportMetricsServiceRequest)
            for each in request.resource_metrics
            for scope in each.scope_metrics
            for metric in scope.metrics
        }
