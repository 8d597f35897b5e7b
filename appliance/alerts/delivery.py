"""Delivers alerts to addresses outside of the fleet, by Apprise: webhooks, e-mail, and what else it knows.

One gateway delivers for all (`messages.sender`). What all addresses took is noted in the alert's record, so that the
gateway that takes over goes on from there: an alert is delivered at least once.
"""

import asyncio
import contextlib
import io
import logging
import threading
import time
from collections.abc import Awaitable, Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import structlog

from appliance.alerts import messages
from appliance.alerts.messages import Course, Message
from appliance.alerts.settings import AlertsConfig
from appliance.errors import ConfigError, SwiftbotError
from appliance.model.alerts import Alert, AlertList
from appliance.model.gateways import Deliveries

if TYPE_CHECKING:
    from apprise import NotifyBase

log = structlog.get_logger(__name__)
T = TypeVar("T")

MOST_ADDRESSES = 16
MOST_BYTES = 65536
LOOK_S = 1.0
ASK_S = 30.0
"""How often the gateway that delivers asks the others for their alerts: what it was not told it learns so."""
MOST_MARKED = 32
"""Alerts whose records are marked as delivered at one look."""
MAX_REASON = 160
ANSWER_S = 60.0
"""A service that has not answered by then holds the others up no longer."""
HOSTED = frozenset({"json", "jsons", "xml", "xmls", "form", "forms", "mailto", "mailtos"})
"""Kinds of addresses whose host is one."""


class Address:
    """One service that alerts are delivered to."""

    def __init__(self, line: int, plugin: "NotifyBase") -> None:
        self._plugin = plugin
        host = str(getattr(plugin, "host", None) or "")
        # Of most services the host of an address is no host, but a token.
        shown = host if str(getattr(plugin, "schema", "")) in HOSTED else ""
        self.name = f"line {line} ({' '.join(filter(None, (str(plugin.service_name), shown)))})"
        """Without what may be secret."""
        hidden = (getattr(plugin, "password", None), getattr(plugin, "user", None), "" if shown else host)
        self._secrets = [str(each) for each in hidden if each]

    def send(self, title: str, body: str, *, critical: bool = False, over: bool = False) -> str:
        """Deliver a message; returns why the service did not take it, empty when it did. Waits for the service."""
        import apprise  # noqa: PLC0415 - only where alerts are delivered

        kind = apprise.NotifyType.FAILURE if critical else apprise.NotifyType.WARNING
        if over:
            kind = apprise.NotifyType.SUCCESS
        try:
            with _warnings() as said:
                taken = self._plugin.notify(body=body, title=title, notify_type=kind)
        except Exception as error:  # noqa: BLE001 - of any of a hundred services
            return self._reason(type(error).__name__)  # what it says may have the address in it
        return "" if taken else self._reason(said.getvalue())

    def _reason(self, text: str) -> str:
        reason = " ".join(text.split()) or "not taken"
        for secret in self._secrets:
            reason = reason.replace(secret, "***")
        return reason[:MAX_REASON]


@contextlib.contextmanager
def _warnings() -> Generator[io.StringIO]:
    """Gather what Apprise logs meanwhile: it says by that alone why something does not work."""
    said = io.StringIO()
    handler, logger = logging.StreamHandler(said), logging.getLogger("apprise")
    handler.setLevel(logging.WARNING)
    logger.addHandler(handler)
    try:
        yield said
    finally:
        logger.removeHandler(handler)


def read_addresses(file: Path) -> tuple[list[Address], list[str]]:
    """Return the addresses of a file and what is wrong in it; the first call takes a second, for Apprise.

    Raises:
        ConfigError: the file cannot be read, or there is no address in it.
    """
    try:
        with file.open(encoding="utf-8") as opened:
            text = opened.read(MOST_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise ConfigError(
            f"alerts.urls_file {file} cannot be read: {reason}", remedy="write addresses to it"
        ) from error
    import apprise  # noqa: PLC0415 - only where alerts are delivered

    # Nothing is fetched from elsewhere, kept on disk, or sent on to where an answer says.
    asset = apprise.AppriseAsset(
        app_id="SwiftBot", app_desc="SwiftBot", app_url="", image_url_mask=None, image_url_logo=None,
        http_redirects=False, storage_mode=apprise.PersistentStoreMode.MEMORY,
    )  # fmt: skip
    found: list[Address] = []
    wrong: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        url = line.strip()
        if not url or url.startswith("#"):
            continue
        with _warnings():
            plugin = apprise.Apprise.instantiate(url, asset=asset)  # pyright: ignore[reportUnknownMemberType]
        if plugin is None:
            wrong.append(f"line {number} is no address that Apprise knows")
        elif len(found) < MOST_ADDRESSES:
            if "overflow=" not in url:  # else a service that takes so many characters refuses each longer message
                plugin.overflow_mode = apprise.OverflowMode.TRUNCATE
            found.append(Address(number, plugin))
        else:
            wrong.append(f"line {number} is more than {MOST_ADDRESSES} addresses")
    if not found:
        raise ConfigError(
            f"alerts.urls_file {file}: {'; '.join(wrong[:3]) or 'no address in it'}",
            remedy="write one address a line, such as jsons://host/path or mailtos://user:password@host",
        )
    return found, wrong


class Delivery:
    """Delivers the alerts of a fleet while it runs, whenever it is this gateway's turn.

    Args:
        config: where to, and how often.
        fleet: its name.
        mine: whether it is this gateway's turn.
        alerts: asks the fleet for its alerts.
        mark: notes in the record of an alert that it is delivered.
        on_change: called when `status` has changed.
    """

    def __init__(
        self,
        config: AlertsConfig,
        *,
        fleet: str,
        mine: Callable[[], bool],
        alerts: Callable[[], Awaitable[AlertList]],
        mark: Callable[[Alert], Awaitable[None]],
        on_change: Callable[[], None],
    ) -> None:
        self._config, self._fleet = config, fleet
        self._mine, self._ask, self._mark, self._on_change = mine, alerts, mark, on_change
        self._file = config.file
        self._version: tuple[int, ...] | None = None
        """Of the file whose addresses are used."""
        self._addresses: list[Address] = []
        self._courses: dict[str, Course] = {}
        self._alerts: dict[str, Alert] = {}
        self._asked_at = float("-inf")
        self._news = asyncio.Event()
        self._file_problem = ""
        self._sent = self._failed = 0

    def hear(self, alert: Alert) -> None:
        """Take an alert as it is now, or is over."""
        if alert.cleared_ns:
            self._alerts.pop(alert.id, None)
            for course in self._courses.values():
                course.end(alert)
        else:
            self._alerts[alert.id] = alert
        self._news.set()

    @property
    def status(self) -> Deliveries:
        """What is told of it in the gateway's status."""
        now = time.monotonic()
        failing = [f"{name}: {course.problem}" for name, course in self._courses.items()
                   if course.failures and now - course.failed_at < messages.RECENT_S]  # fmt: skip
        problem = "; ".join(filter(None, (self._file_problem, *failing)))
        return Deliveries(sent=self._sent, failed=self._failed, problem=problem[:300])

    async def run(self) -> None:
        """Deliver until cancelled."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_S):
                    await self._news.wait()
            self._news.clear()
            before = self.status
            try:
                await self._look()
            except SwiftbotError as error:
                log.info("alerts are delivered later", reason=str(error))
            except Exception:  # supervision boundary: what cannot be delivered now is tried again
                log.exception("alerts could not be delivered")
            if self.status.problem != before.problem:
                self._on_change()
            await asyncio.sleep(LOOK_S / 4)  # what happens together is delivered together

    async def _look(self) -> None:
        await self._read_file()
        if not self._addresses or not self._mine():
            self._asked_at = float("-inf")
            return
        if time.monotonic() - self._asked_at >= ASK_S:
            await self._ask_fleet()
            self._asked_at = time.monotonic()
        for address in self._addresses:
            course = self._courses[address.name]
            course.see(self._alerts.values())
            message = course.message(self._alerts.values(), self._config, fleet=self._fleet, now=time.monotonic())
            if message is not None:
                await self._deliver(address, course, message)
        marked = messages.delivered(self._alerts.values(), self._courses.values(), now=time.monotonic())
        for alert in marked[:MOST_MARKED]:
            await self._mark(alert)

    async def _deliver(self, address: Address, course: Course, message: Message) -> None:
        critical, over = message.critical, not message.news
        try:
            async with asyncio.timeout(ANSWER_S):
                reason = await _apart(lambda: address.send(message.title, message.body, critical=critical, over=over))
        except TimeoutError:
            reason = f"no answer within {ANSWER_S:g} s"
        if reason:
            self._failed += 1
            course.refused(reason, now=time.monotonic())
            log.warning("alerts were not delivered", to=address.name, reason=reason, alerts=len(message.news))
        else:
            self._sent += 1
            course.took(message, self._config, now=time.monotonic())

    async def _ask_fleet(self) -> None:
        """Take the alerts there are; what is not among them any more was over unheard."""
        before = set(self._alerts)
        found = await self._ask()
        self._alerts |= {each.id: each for each in found.alerts}
        if not found.unreachable:
            for name in before - {each.id for each in found.alerts}:
                if (gone := self._alerts.pop(name, None)) is not None:
                    for course in self._courses.values():
                        course.end(gone)

    async def _read_file(self) -> None:
        """Read the addresses where their file has changed; one that cannot be read keeps those before."""
        version = await asyncio.to_thread(_version, self._file)
        if version == self._version and (version is not None or self._file_problem):
            return
        self._version = version
        try:
            self._addresses, wrong = await _apart(lambda: read_addresses(self._file))
        except ConfigError as error:
            self._file_problem = error.message
            log.warning("addresses for alerts are not read", reason=error.message, remedy=error.remedy)
            return
        except Exception as error:  # supervision boundary: of one of Apprise's hundred services
            self._file_problem = f"{self._file}: {type(error).__name__}"
            log.exception("addresses for alerts are not read")
            return
        self._file_problem = f"{self._file}: {'; '.join(wrong[:3])}" if wrong else ""
        self._courses = {each.name: self._courses.get(each.name, Course()) for each in self._addresses}
        for course in self._courses.values():
            if course.failures:
                course.next_at = float("-inf")  # it may be what was corrected
        log.info("alerts are delivered", to=[each.name for each in self._addresses], problem=self._file_problem)


def _version(file: Path) -> tuple[int, ...] | None:
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino  # ctime: the mode may be corrected


async def _apart(work: Callable[[], T]) -> T:
    """Do something in a thread that nobody waits for when this process ends: a service may take a while to answer."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def finish(result: T | None, error: Exception | None) -> None:
        if done.cancelled():
            return
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(result)  # pyright: ignore[reportArgumentType] - there is one without an error

    def carry_out() -> None:
        result, problem = None, None
        try:
            result = work()
        except Exception as error:  # noqa: BLE001 - handed to the one who waits
            problem = error
        with contextlib.suppress(RuntimeError):  # the loop may have ended meanwhile
            loop.call_soon_threadsafe(finish, result, problem)

    threading.Thread(target=carry_out, name="alert delivery", daemon=True).start()
    return await done
