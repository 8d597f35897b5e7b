"""Robots as one gateway has them: its MAVLink vehicles, and the tasks that robots of the fleet ask for.

Zenoh robots speak for themselves and need nothing of a gateway; MAVLink vehicles are spoken for by the station.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

from appliance.model import Site, TaskRequest
from appliance.plane.session import Session
from appliance.robots.doors import Tasks
from appliance.robots.intake import TaskIntake
from appliance.robots.ledger import KeyValues
from appliance.robots.settings import RobotsConfig

if TYPE_CHECKING:
    from appliance.robots.mavlink.station import Station


class RobotHub:
    """One per gateway. `refused` counts bad input by kind; `on_task` and `tasks` take what robots ask for."""

    def __init__(
        self,
        config: RobotsConfig,
        *,
        session: Session,
        store: KeyValues,
        gateway: str,
        site: Site,
        on_task: Callable[[str, TaskRequest], None] | None = None,
        tasks: Tasks | None = None,
    ) -> None:
        self._config = config
        self._session = session
        self._store = store
        self._gateway = gateway
        self._site = site
        self._tasks = tasks
        self.refused: dict[str, int] = {}
        submit = None if tasks is None else tasks.submit
        self._intake = None if on_task is None else TaskIntake(session, on_task, self.refused, submit=submit)
        self._station: Station | None = None

    @property
    def attached(self) -> tuple[str, ...]:
        """Names of the MAVLink vehicles heard since start, online or not."""
        return () if self._station is None else self._station.attached

    async def start(self) -> None:
        """Bind the ports and begin; ConfigError with the remedy when a setting is wrong or a port taken."""
        self._config.check()
        if self._config.mavlink:
            # pymavlink's dialect costs 15 MB and 30 ms: only gateways with vehicles pay for it.
            from appliance.robots.mavlink.station import Station  # noqa: PLC0415

            station = Station(
                self._config,
                session=self._session,
                store=self._store,
                gateway=self._gateway,
                site=self._site,
                refused=self.refused,
                tasks=self._tasks,
            )
            await station.start()
            self._station = station
        if self._intake is not None:
            self._intake.start()

    async def stop(self) -> None:
        """End commands (the next process resumes them), take back what was declared, close the ports."""
        if self._intake is not None:
            self._intake.stop()
        if self._station is not None:
            await self._station.stop()
            self._station = None
