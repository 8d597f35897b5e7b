"""The file of addresses that alerts are delivered to, and what is told of what does not work there."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from appliance.alerts.delivery import MOST_ADDRESSES, Delivery, read_addresses
from appliance.alerts.rules import Facts, findings
from appliance.alerts.settings import AlertsConfig
from appliance.errors import ConfigError
from appliance.model import GatewayStatus
from appliance.model.alerts import Alert, AlertLevel, AlertList, Subject
from appliance.model.gateways import Deliveries

from .test_messages import LOST

pytestmark = pytest.mark.anyio


def test_addresses_are_named_without_their_secrets(tmp_path: Path) -> None:
    """By line, service and host; comments and empty lines are none; a line that is no address is told."""
    file = tmp_path / "urls"
    file.write_text(
        "# alerts\n\njsons://ann:s3cret@hook.example/p?+Token=abc\nnonsense://x\nmailtos://u:pw@example.org\n"
    )
    found, wrong = read_addresses(file)
    assert [each.name for each in found] == ["line 3 (JSON hook.example)", "line 5 (E-Mail example.org)"]
    assert wrong == ["line 4 is no address that Apprise knows"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot be read: No such file or directory"),
        (b"\xff\xfe", "cannot be read: it is not UTF-8"),
        (b"# nothing\n", "no address in it"),
        (b"hello\n", "line 1 is no address that Apprise knows"),
    ],
)
def test_a_file_without_addresses_is_refused(tmp_path: Path, text: bytes | None, said: str) -> None:
    """With what is wrong, and what an address looks like."""
    file = tmp_path / "urls"
    if text is not None:
        file.write_bytes(text)
    with pytest.raises(ConfigError) as caught:
        read_addresses(file)
    assert said in caught.value.message
    assert caught.value.remedy


def test_a_token_in_place_of_a_host_is_no_name(tmp_path: Path) -> None:
    """Of services whose address has a token instead of a host, the service alone is named, in reasons too."""
    file = tmp_path / "urls"
    file.write_text(f"pbul://{'a' * 32}\ndiscord://{'1' * 18}/{'b' * 60}\n")
    found, wrong = read_addresses(file)
    assert [each.name for each in found] == ["line 1 (Pushbullet)", "line 2 (Discord)"]
    assert not wrong
    assert "a" * 32 not in found[0]._reason(f"{'x' * 150} {'a' * 32} failed")
    assert "aaa" not in found[0]._reason(f"{'x' * 150} {'a' * 32} failed")


def test_there_are_only_so_many_addresses(tmp_path: Path) -> None:
    """Further ones are told, not dropped unsaid."""
    file = tmp_path / "urls"
    file.write_text("json://localhost\n" * (MOST_ADDRESSES + 1))
    found, wrong = read_addresses(file)
    assert len(found) == MOST_ADDRESSES
    assert wrong == [f"line {MOST_ADDRESSES + 1} is more than {MOST_ADDRESSES} addresses"]


def test_a_service_that_does_not_answer_gives_the_reason(tmp_path: Path) -> None:
    """Nothing listens at port 9 of this machine; the password is in no reason."""
    file = tmp_path / "urls"
    file.write_text("json://ann:s3cret@127.0.0.1:9/hook?cto=1\n")
    (address,), _ = read_addresses(file)
    reason = address.send("title", "body")
    assert "Connection error" in reason
    assert "s3cret" not in reason


async def test_a_file_that_is_mended_is_read_again(tmp_path: Path) -> None:
    """Until then the status tells what is wrong; what was to be delivered is delivered then."""
    file = tmp_path / "urls"
    changes: list[str] = []
    marked: list[Alert] = []

    async def alerts() -> AlertList:
        return AlertList(alerts=(LOST,))

    async def mark(alert: Alert) -> None:
        marked.append(alert)

    delivery = Delivery(
        AlertsConfig(urls_file=str(file), every_s=1), fleet="yard", mine=lambda: True, alerts=alerts, mark=mark,
        on_change=lambda: changes.append(delivery.status.problem),
    )  # fmt: skip
    running = asyncio.create_task(delivery.run())
    server = await asyncio.start_server(_answer, "127.0.0.1", 0)
    try:
        async with server, asyncio.timeout(60):
            await _until(lambda: "No such file" in delivery.status.problem)
            file.write_text(f"json://127.0.0.1:{server.sockets[0].getsockname()[1]}/hook\n")
            await _until(lambda: bool(marked))
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    assert (marked[0].id, delivery.status.sent, delivery.status.problem) == (LOST.id, 1, "")
    assert changes[-1] == ""


def test_the_alert_of_a_gateway_that_cannot_deliver() -> None:
    """It is a warning about that gateway, with the reason and what to do."""
    status = GatewayStatus(id="gw-1", fleet="yard", delivery=Deliveries(failed=3, problem="line 1 (JSON h): no route"))
    found = findings(Facts(gateways={"gw-1": status}))["delivery.gw-1"]
    assert (found.level, found.subject) == (AlertLevel.WARNING, Subject.GATEWAY)
    assert found.what == "alerts are not delivered: line 1 (JSON h): no route"
    assert "swiftbot alerts test" in found.remedy


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Take one request."""
    await reader.readuntil(b"\r\n\r\n")
    writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
    await writer.drain()
    writer.close()


async def _until(holds: Callable[[], bool]) -> None:
    while not holds():
        await asyncio.sleep(0.05)
