"""A real HTTP server that speaks as the upstream tier expects, or misbehaves on request."""

import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from appliance.llm.settings import LlmConfig, PlanContext
from appliance.llm.upstream import UpstreamTier
from appliance.skills.catalogue import load_catalogue

CATALOGUE = load_catalogue()

ASK = PlanContext(instruction="Rover_1: go to dock 1")

PLAN = {
    "domain": "navigation",
    "subtasks": [{"id": "s1", "skill": "goto", "robot": "rover_1", "params": {"place": "dock 1"}, "after": []}],
}

Answer = tuple[int, bytes] | float
"""Status and body, or seconds of silence."""


def completion(content: Any, **more: Any) -> tuple[int, bytes]:
    """Return a chat completion as servers send it."""
    text = content if isinstance(content, str) else json.dumps(content)
    choice = {"index": 0, "message": {"role": "assistant", "content": text}, "finish_reason": "stop", **more}
    return 200, json.dumps({"id": "c1", "object": "chat.completion", "choices": [choice], "usage": {}}).encode()


class Server:
    """An OpenAI-compatible server that answers as prepared, in order; the last answer stays."""

    def __init__(self) -> None:
        self.answers: list[Answer | Callable[[dict[str, Any]], Answer]] = []
        self.asked: list[dict[str, Any]] = []
        self.paths: list[str] = []
        self.keys: list[str | None] = []
        self.closing = threading.Event()
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                server.handle(self)

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._http.daemon_threads = True
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02})
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._http.server_address[1]}/v1"

    def handle(self, request: BaseHTTPRequestHandler) -> None:
        """Answer one request."""
        body = json.loads(request.rfile.read(int(request.headers["content-length"])))
        self.asked.append(body)
        self.paths.append(request.path)
        self.keys.append(request.headers.get("authorization"))
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        answer = answer(body) if callable(answer) else answer
        if isinstance(answer, float):
            self.closing.wait(answer)
            return
        status, data = answer
        request.send_response(status)
        request.send_header("content-length", str(len(data)))
        request.end_headers()
        request.wfile.write(data)

    def close(self) -> None:
        """Stop."""
        self.closing.set()
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()


def config(server: Server, **more: Any) -> LlmConfig:
    """Return a configuration that points at the server."""
    given = {"local_model": "", "upstream_url": server.url, "upstream_model": "big", "upstream_deadline_s": 5.0}
    return LlmConfig(**given | more)


async def ask(server: Server, **more: Any) -> Any:
    """Put one instruction to an upstream tier and close it."""
    tier = UpstreamTier(config(server, **more), CATALOGUE)
    await tier.start()
    try:
        return await tier.propose(ASK)
    finally:
        await tier.close()
