"""Alerts are delivered by webhook and e-mail, to servers of this machine, by another gateway where one is gone."""

import asyncio
import json
import re
from collections.abc import AsyncIterator, Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from aiosmtpd.controller import Controller
from aiosmtpd.smtp import SMTP, Envelope, Session
from fleets import PLAIN, alerts_until, command, fleet_in, kill, swiftbot
from msgspec.structs import replace

from appliance.alerts.settings import AlertsConfig
from appliance.client import FleetClient
from appliance.config import dump
from appliance.connection import FleetState
from appliance.ports import free_port

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.long]
WAIT_S = 60.0


class Hook:
    """A server that takes webhooks, or refuses them."""

    def __init__(self) -> None:
        self.got: list[dict[str, Any]] = []
        self.answer = 200
        hook = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                if hook.answer == 200:
                    hook.got.append(json.loads(body))
                self.send_response(hook.answer)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
                """Say nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._thread = Thread(target=self._server.serve_forever)
        self._thread.start()

    @property
    def url(self) -> str:
        """Its address, as Apprise writes it."""
        return f"json://127.0.0.1:{self._server.server_port}/alerts"

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class Mailbox:
    """What an SMTP server takes."""

    def __init__(self) -> None:
        self.got: list[str] = []

    async def handle_DATA(self, _server: SMTP, _session: Session, envelope: Envelope) -> str:  # noqa: N802 - aiosmtpd's
        """Take one mail."""
        assert envelope.rcpt_tos == ["olga@example.org"]
        self.got.append(bytes(envelope.content or b"").decode())
        return "250 OK"


@pytest.fixture
async def hook() -> AsyncIterator[Hook]:
    """A server for webhooks."""
    made = Hook()
    yield made
    await asyncio.to_thread(made.close)


@pytest.fixture
async def mail() -> AsyncIterator[tuple[Mailbox, str]]:
    """An SMTP server, and its address as Apprise writes it."""
    box = Mailbox()
    port = free_port()
    controller = Controller(box, hostname="127.0.0.1", port=port)
    controller.start()
    yield box, f"mailto://localhost:{port}/olga@example.org?from=swiftbot@example.org"
    controller.stop()


@pytest.fixture
async def fleet(tmp_path: Path, hook: Hook, mail: tuple[Mailbox, str]) -> AsyncIterator[FleetState]:
    """Two gateways that deliver to both, and two rovers."""
    urls = tmp_path / "alerts.urls"
    urls.write_text(f"# where alerts go\n{hook.url}\n{mail[1]}\n")
    base = replace(PLAIN, alerts=AlertsConfig(urls_file=str(urls), every_s=1.0))
    (tmp_path / "gateway.toml").write_text(dump(base))
    async with fleet_in(tmp_path, gateways=2, zenoh=2, base=base) as state:
        yield state


async def until(holds: Callable[[], bool], what: str) -> None:
    """Wait until something is so."""
    try:
        async with asyncio.timeout(WAIT_S):
            while not holds():
                await asyncio.sleep(0.1)
    except TimeoutError:
        pytest.fail(f"{what} within {WAIT_S:g} s")


@pytest.mark.timeout(300)
async def test_alerts_reach_webhook_and_mailbox(
    fleet: FleetState, hook: Hook, mail: tuple[Mailbox, str], tmp_path: Path
) -> None:
    """Told once by one gateway; a refusal is counted, told by an alert and made up for; the other takes over."""
    box = mail[0]

    def told(what: str) -> list[dict[str, Any]]:
        return [each for each in hook.got if what in each["message"]]

    async with FleetClient(fleet.endpoint) as client:
        kill(fleet, "rover_2")
        await until(lambda: bool(told("robot rover_2: offline")), "no webhook of the robot")
        await until(lambda: any("robot rover_2: offline" in each for each in box.got), "no mail of the robot")
        assert told("rover_2")[0]["type"] == "failure"
        assert "critical" in told("rover_2")[0]["title"]
        assert "Subject: SwiftBot" in box.got[0]
        await alerts_until(client, lambda found: found["robot-offline.rover_2"].told_ns > 0)

        # A service that refuses: an alert says so, and once it takes messages again it gets what it missed.
        hook.answer = 503
        kill(fleet, "rover_1")
        found = await alerts_until(client, lambda found: any(name.startswith("delivery.") for name in found))
        (problem,) = (each.what for name, each in found.items() if name.startswith("delivery."))
        assert "alerts are not delivered: line 2 (JSON 127.0.0.1): " in problem
        assert "503" in problem
        hook.answer = 200
        await until(lambda: bool(told("robot rover_1: offline")), "no webhook of what was refused")
        assert len(told("robot rover_2: offline")) == 1
        _, out, _ = await swiftbot(fleet, "fleet", "--json")
        assert re.search(r'"failed": ?[1-9]', out)

        # The gateway that delivers is gone: the other delivers, also that.
        kill(fleet, "gw-1")
        await until(lambda: bool(told("gateway gw-1: does not answer")), "no webhook of the gateway")
    code, out, _ = await command("alerts", "test", "--config", str(tmp_path / "gateway.toml"))
    assert (code, out.count("✔")) == (0, 2)
    assert told("A test by base")
    hook.answer = 403
    code, out, _ = await command("alerts", "test", "--json", "--config", str(tmp_path / "gateway.toml"))
    rows = json.loads(out)
    assert code == 1
    assert [row["taken"] for row in rows] == [False, True]
