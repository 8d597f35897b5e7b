"""Composition root of the daemon: builds the parts, starts them in order, watches them, stops them in reverse.

Order: plane (others can find us) → language model → robots → pool → tasks; the gateway takes part in the ring
from the first step but accepts runs only when its pool is there. On SIGTERM: say that we drain, let runs end,
hand over coordination (the next owner of each key goes on), leave the warm containers for the next start.

State volumes and images (`StateHere`): their parts are the pool's (`pool.volumes`); here they are
built, told of what others hold, and asked what this gateway says of itself; there are none without Podman.
"""

import asyncio
import contextlib
import functools
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance import logs, process
from appliance.alerts.delivery import Delivery
from appliance.alerts.keeper import Keeper, disk_mb
from appliance.alerts.messages import sender
from appliance.charging.keeper import Charging
from appliance.closures import keeper as closures
from appliance.closures.keeper import Closures
from appliance.config import GatewayConfig
from appliance.errors import ConfigError, PrerequisiteError
from appliance.floor.keeper import FloorKeeper
from appliance.identity.parts import ALL, DEVELOPMENT, InForce, Kind
from appliance.identity.parts import FILE as PARTS_FILE
from appliance.learn import records as learn_records
from appliance.learn.manager import LearnManager
from appliance.llm.cascade import Decomposer
from appliance.llm.checks.safety import strictest
from appliance.llm.peers import PeerTier
from appliance.llm.settings import OutOfUse, PlanContext
from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    LogLine,
    Plan,
    RobotInfo,
    Site,
    VolumeInfo,
    gateways,
    keyspace,
)
from appliance.model.alerts import Alert, AlertsAsk
from appliance.model.planner_api import ProposeAsk, Proposed, SwapAsk, Swapped
from appliance.model.recorder_api import RecorderStatus
from appliance.model.robot_api import LinksAsk
from appliance.model.task_api import ArtifactAsk, ArtifactKeep, ArtifactKept, ArtifactPiece, SiteAsk
from appliance.observe.facts import Facts
from appliance.plane.events import AuthorityChanged, FactsChanged, FleetEvent, Lost, Stage
from appliance.plane.node import Plane
from appliance.plane.records import Record
from appliance.pool.engine import PodmanEngine
from appliance.pool.images import reference
from appliance.pool.pool import Pool
from appliance.pool.selection import UNMEASURED, Link
from appliance.pool.settings import PoolConfig
from appliance.pool.signed import without_unsigned
from appliance.pool.volumes import ALONE, State
from appliance.pool.volumes.registry import Volumes
from appliance.pool.volumes.transfers import Transfers
from appliance.process import Supervisor, Vitals
from appliance.record.models import Recorders
from appliance.robot_tasks import RobotTasks
from appliance.robots.authority.authority import SHOWN, Authority
from appliance.robots.hub import RobotHub
from appliance.robots.limits import Bounds, Orders, Usual
from appliance.schedules import records as schedule_records
from appliance.schedules.manager import ScheduleManager
from appliance.skills.catalogue import Catalogue, load_catalogue
from appliance.skills.sites import differs, load_site
from appliance.tasks.admission import refuse_commands
from appliance.tasks.artifacts import SPARE_PLACES, ArtifactCopies, Artifacts
from appliance.tasks.audit import Audit
from appliance.tasks.conflicts import resolver
from appliance.tasks.enquiries import Enquiries
from appliance.tasks.executor import Executor, Telling
from appliance.tasks.handler_calls import Calls
from appliance.tasks.handoff import Holds, Reservations, Source
from appliance.tasks.manager import TaskManager
from appliance.tasks.migration.gateway import Migration
from appliance.tasks.migration.policy import Load
from appliance.tasks.offload import RemoteContainers
from appliance.tasks.retention import Retention
from appliance.tasks.stream import Kept
from appliance.tasks.views import status as task_status

if TYPE_CHECKING:
    from appliance.observe.observer import Observer

T = TypeVar("T")


def orders_of(config: GatewayConfig, site: Site, *, roster: Callable[[], Mapping[str, RobotInfo]]) -> Orders:
    """Return it; `roster` gives the robots as they are known when an order is given."""
    robots, limits = config.robots, config.safety.limits

    def configured(robot: str) -> Bounds:
        return Bounds(
            whose=f"the limits of {robot} in [safety]",
            speed_mps=strictest(limits, robot, "speed_mps"),
            altitude_m=strictest(limits, robot, "altitude_m"),
        )

    def vehicles(flies: bool) -> Usual:
        return Usual(speed_mps=robots.cruise_mps if flies else robots.drive_mps, takeoff_m=robots.takeoff_altitude_m)

    return Orders(site, roster=roster, configured=configured, vehicles=vehicles)


log = structlog.get_logger(__name__)


class StateHere:
    """The ledger of state volumes, and the transfers of them and of images; `open` it, `close` it in any case."""

    def __init__(
        self,
        config: PoolConfig,
        *,
        plane: Plane,
        fleet: str,
        data_dir: Path,
        on_change: Callable[[], None],
        parts: InForce = ALL,
    ) -> None:
        self._parts = parts
        self.state: State = ALONE
        """What the pool may do with state; nothing without Podman."""
        self._config = config
        self._plane = plane
        self._fleet = fleet
        self._data = data_dir
        self._on_change = on_change
        self._volumes: Volumes | None = None
        self._transfers: Transfers | None = None
        self._stack = contextlib.AsyncExitStack()

    async def open(self, signed: Callable[[str, Any], Any] = lambda _, handler: handler) -> None:
        """Build and start the parts.

        Args:
            signed: puts an audit around the handler of an operator's verb.
        """
        try:
            storage = PodmanEngine.for_transfers(self._config.podman_url)
        except PrerequisiteError as error:
            log.warning("state volumes and images cannot be moved", reason=str(error))
            return

        async def let_go() -> None:
            await asyncio.to_thread(storage.close)

        self._stack.push_async_callback(let_go)
        plane, settings = self._plane, self._config.transfer
        self._volumes = volumes = Volumes(
            settings, fleet=self._fleet, gateway=plane.gateway, store=plane.store, records=plane.dht, storage=storage,
            on_change=self._on_change,
        )  # fmt: skip
        await volumes.start()
        self._stack.push_async_callback(volumes.close)
        self._stack.callback(plane.events.subscribe(Stage.VOLUMES, self._on_event))
        self._transfers = transfers = Transfers(
            settings, plane=plane, volumes=volumes, storage=storage, data_dir=self._data, on_change=self._on_change,
            parts=self._parts,
        )  # fmt: skip
        await transfers.start(signed)
        self._stack.push_async_callback(transfers.close)
        self.state = State(
            bring=transfers.bring_newest,
            use=volumes.use,
            newest_here=volumes.newest_here,
            bring_image=transfers.bring_image,
        )

    def link(self, gateway: str) -> Link:
        """Return what is measured of moving state from a gateway."""
        return self._transfers.link(gateway) if self._transfers is not None else UNMEASURED

    def _on_event(self, event: FleetEvent) -> None:
        if self._volumes is None:
            return
        match event:
            case Lost(gateway):
                self._volumes.hear(gateway, ())
            case FactsChanged("gateway"):
                for gateway, status in self._plane.registry.gateways.items():
                    if gateway != self._plane.gateway:
                        self._volumes.hear(gateway, status.volumes)
            case _:
                pass

    def volumes_mb(self, names: Iterable[str]) -> float:
        """Size of the newest states of volumes that are not here, MiB: what would have to come."""
        return self._volumes.size_bytes(names) / 2**20 if self._volumes is not None else 0.0

    def volumes(self) -> tuple[VolumeInfo, ...]:
        """The volumes whose newest state is here."""
        return self._volumes.infos() if self._volumes is not None else ()

    def images(self) -> tuple[str, ...]:
        """References of the images here that others may fetch."""
        return self._transfers.images() if self._transfers is not None else ()

    @property
    def refused(self) -> list[dict[str, int]]:
        """Counts of bad input, by kind."""
        return [each.refused for each in (self._volumes, self._transfers) if each is not None]

    async def close(self) -> None:
        """Stop the parts in reverse order."""
        await self._stack.aclose()


def resolve(key: str, one: Record, other: Record) -> Record:
    """Choose between concurrent versions of any record, by the room whose record it is."""
    if key.startswith(keyspace.CLOSURE_RECORD.prefix):
        return closures.resolve(one, other)
    if schedule_records.is_ours(key):
        return schedule_records.resolve(key, one, other)
    return (learn_records.resolve if key.startswith(learn_records.PREFIX) else resolver)(key, one, other)


def both(first: Callable[[T], None], second: Callable[[T], None] | None) -> Callable[[T], None]:
    """Return what hands a thing to both; without a second it is the first."""
    if second is None:
        return first

    def hear(thing: T) -> None:
        first(thing)
        second(thing)

    return hear


VERSION = "0.1.0"
SITE_S = 10.0
"""How often a gateway looks whether the site's file is still what it uses."""
SETTLE_S = 3.0
"""How long a draining gateway waits for the ends of its runs to be written: a replicated write takes milliseconds."""


class Gateway:
    """One gateway. `start` and `stop` do all; `run` is the daemon around them."""

    def __init__(self, config: GatewayConfig) -> None:
        self.config = config
        self._data = Path(config.data_dir).expanduser()
        self._started_ns = time.time_ns()
        self._stack = contextlib.AsyncExitStack()
        self.supervisor = Supervisor()
        self._vitals = Vitals()
        self._changed = asyncio.Event()
        self._draining = False
        self._kept = Kept(config.id)
        """The last lines about tasks that this gateway has said."""
        self._site_problem = ""
        self._recorders = Recorders()
        self._parts = ALL
        self._observer: Observer | None = None
        """Tells monitoring systems; None: nothing of that is on."""
        self._delivery: Delivery | None = None
        """Delivers alerts outside of the fleet; None: there are no addresses."""

    async def start(self) -> None:
        """Build and start every part; on failure, what was started is stopped again and the error raised."""
        try:
            await self._start()
        except BaseException:
            await self._stack.aclose()
            raise

    async def _start(self) -> None:
        config = self.config
        catalogue, site = self._load()
        self._site_problem = "" if site.fence is not None else f"site {site.name} has no fence"
        self._make_directories()
        self.plane = await Plane.open(
            config.plane, fleet=config.fleet, gateway=config.id, data_dir=self._data, resolver=resolve
        )
        self._stack.push_async_callback(self.plane.close)
        observer = self._start_telling()
        await self.plane.until_back()
        catalogue = await self._take_parts(catalogue)

        await self._start_planner(catalogue)

        self._listen_to_recorders()

        audit = Audit(self.plane.session, self.plane.keys, config.id)
        self._stack.callback(audit.listen().close)
        orders = orders_of(config, site, roster=lambda: self.plane.registry.robots)
        await self._start_robots(site, audit, orders)

        artifacts = Artifacts(
            self._data / "artifacts",
            gateway=config.id,
            max_bytes=config.tasks.max_artifact_mb * 2**20,
            reserve_bytes=config.tasks.artifact_reserve_mb * 2**20,
        )
        copies = ArtifactCopies(
            gateway=config.id,
            copies=config.tasks.artifact_copies,
            places=lambda digest: self.plane.ring.successors(digest, config.tasks.artifact_copies + SPARE_PLACES),
            ask=self._ask_to_keep,
        )
        enquiries = Enquiries(self.plane)
        enquiries.start(audit)
        self._stack.push_async_callback(enquiries.close)
        telling = Telling(self.plane, both(self._kept.hear_event, observer and observer.hear_event))
        self._calls = calls = Calls(
            self.plane,
            artifacts,
            copies=copies,
            on_wait=telling.waits,
            hindrance=self.authority.hindrance,
            enquiries=enquiries,
            floor=self.floor,
            orders=orders.held,
        )
        self._storage = storage = StateHere(
            config.pool, plane=self.plane, fleet=config.fleet, data_dir=self._data, on_change=self._changed.set,
            parts=self._parts,
        )  # fmt: skip
        self._stack.push_async_callback(storage.close)
        await storage.open(audit.signed)
        self._remote = remote = RemoteContainers(self.plane, successors=config.plane.find_successors, link=storage.link)

        # Handlers' calls go through the holds, of which the runs that leave are made once there is an executor.
        holds = Holds()
        self.pool = Pool(
            config.pool,
            gateway=config.id,
            fleet=config.fleet,
            run_dir=self._run_dir(),
            data_dir=self._data,
            catalogue=catalogue,
            site=site,
            find_remote=remote.find,
            facts=remote.facts,
            on_call=functools.partial(holds.guard, carry_out=observer.timed(calls) if observer else calls),
            on_change=self._on_containers,
            state=storage.state,
            store=self.plane.store,
            on_decided=self._tell_decided,
            parts=self._parts,
            max_result_bytes=config.tasks.max_result_bytes,
        )
        reservations = Reservations(config.id, self.pool)
        self.executor = Executor(
            self.plane, self.pool, remote, config.tasks, telling=telling, reservations=reservations,
            on_change=self._changed.set,
        )  # fmt: skip
        await self.executor.start()
        await self.pool.start()
        self._stack.push_async_callback(self._stop_pool)

        rpc = self.plane.rpc
        rpc.register(keyspace.RUN, self.executor.run)
        rpc.register(keyspace.RUN_STATUS, self.executor.status)
        rpc.register(keyspace.RUN_CANCEL, self.executor.cancel)
        rpc.register(keyspace.ARTIFACT, artifacts.piece)
        rpc.register(keyspace.ARTIFACT_KEEP, functools.partial(artifacts.keep, ask=self._ask_for_piece))

        async def tell_site(_: SiteAsk) -> Site:
            return site

        rpc.register(keyspace.SITE, tell_site)
        rpc.register(keyspace.FIND_CONTAINERS, remote.answer)
        self._serve_operators(audit)

        self._keep_alerts(audit)
        self.manager = TaskManager(
            config.tasks,
            plane=self.plane,
            catalogue=catalogue,
            decomposer=self.decomposer,
            site=site,
            image_of=self._image_names(catalogue),
            commands=self.authority,
            out_of_use=self._out_of_use,
            audit=audit,
            on_change=self._changed.set,
            on_transition=both(self._kept.hear_transition, observer and observer.hear_transition),
            on_record=both(self._alerts.moved, observer and observer.hear_record),
            runs=telling,
        )
        rpc.register(keyspace.TASK_LINES, self._kept.answer)
        await self.manager.start()
        self._stack.push_async_callback(self.manager.stop)
        source = Source(config.id, self.executor, holds=holds, skills=catalogue.skills, config=config.tasks.migration)
        self.migration = Migration(
            self.plane,
            self.pool,
            executor=self.executor,
            source=source,
            reservations=reservations,
            coordinator=self.manager.coordinator,
            manifest=self.manager.context.manifest,
            config=config.tasks.migration,
            load=self._own_load,
            volumes_mb=storage.volumes_mb,
            on_change=self._changed.set,
            audit=audit,
        )
        self.migration.start()
        self._stack.push_async_callback(self.migration.close)
        self._take_tasks(audit, site)
        self._retention = await self._start_learning(artifacts, audit)
        self._publish_status()
        root_tasks = {
            "status": self._keep_publishing(),
            "session": self.plane.until_gone(),
            "retention": self._retention.run(),
            "copies of files": copies.run(),
            "site": self._watch_site(site),
        }
        root_tasks |= {"observer": observer.run()} if observer else {}
        root_tasks |= {"delivery of alerts": self._delivery.run()} if self._delivery else {}
        for name, work in root_tasks.items():
            self._stack.push_async_callback(self.supervisor.start(name, work))
        log.info("gateway is up", gateway=config.id, fleet=config.fleet, pid=os.getpid())

    async def _start_learning(self, artifacts: Artifacts, audit: Audit) -> Retention:
        """Take up runs of federated learning; returns what forgets old records, those of its runs excepted."""
        manifest = self.manager.context.manifest
        self.learn = LearnManager(
            self.plane,
            artifacts,
            manifest=manifest,
            copies=self.config.plane.replicas,
            folder=self._learning_folder(),
            keep_ended=self.config.tasks.keep_runs,
            tell_decisions=self.config.tasks.tell_decisions,
        )
        self._calls.offer("masks", self.learn.masks)
        await self.learn.start(audit)
        self._stack.push_async_callback(self.learn.stop)
        return Retention(self.plane, self.config.tasks, artifacts, needed=self.learn.needed)

    def _start_telling(self) -> "Observer | None":
        """Publish log lines; returns what tells monitoring systems, whose packages are loaded only where that is on."""
        config = self.config
        if config.observe.active:
            from appliance.observe.observer import Observer  # noqa: PLC0415

            self._observer = Observer(
                config.observe, fleet=config.fleet, gateway=config.id, version=VERSION, facts=self._facts
            )
            self._stack.push_async_callback(self._observer.close)
        logs.publish_to(self._put_log)
        self._stack.callback(logs.publish_to, None)
        return self._observer

    async def _facts(self) -> Facts:
        """What metrics are made of."""
        return Facts(
            status=self.status(),
            containers=self.pool.containers(),
            alerts=(await self._alerts.alerts(AlertsAsk(local=True))).alerts,
            links=(await self.hub.links(LinksAsk())).links,
            robots={robot.id: robot.online for robot in self.plane.registry.robots.values()},
            gateways=len(self.plane.members()),
            tasks=Counter(map(task_status, self.manager.records)),
        )

    def _take_tasks(self, audit: Audit, site: Site) -> None:
        """Take tasks from robots, from the schedules that are this gateway's, and for robots that have to charge."""
        self._robot_tasks.open(self.manager.submit, self.manager.questions)
        self._stack.callback(self._robot_tasks.close)
        schedules = ScheduleManager(
            self.plane,
            submit=audit.submission(self.manager.submit),
            task=self.manager.questions.task,
            check=lambda request: refuse_commands(request, self.plane.registry.robots),
            report=self._alerts.report,
        )
        schedules.start(audit)
        self._stack.push_async_callback(schedules.stop)
        charging = Charging(
            self.plane,
            site,
            self.config.tasks.battery,
            floor=self.floor,
            work=self.manager.scheduler.fleet_work,
            hindrance=self.authority.hindrance,
            closed=lambda: self.closures.places,
            submit=audit.submission(self.manager.submit),
            task=self.manager.questions.task,
        )
        charging.start()
        self._stack.push_async_callback(charging.stop)

    def _learning_folder(self) -> Path:
        """Where this gateway's data sets and people's own models are."""
        return Path(self.config.pool.folders.get("learning") or self._data / "folders" / "learning").expanduser()

    async def _ask_to_keep(self, gateway: str, asked: ArtifactKeep) -> ArtifactKept:
        return await self.plane.rpc.call(gateway, keyspace.ARTIFACT_KEEP, asked)

    async def _ask_for_piece(self, gateway: str, asked: ArtifactAsk) -> ArtifactPiece:
        return await self.plane.rpc.call(gateway, keyspace.ARTIFACT, asked)

    async def _start_robots(self, site: Site, audit: Audit, orders: Orders) -> None:
        config = self.config
        self.closures = closures = Closures(self.plane, site)
        await closures.start(audit.signed)
        self._stack.push_async_callback(closures.close)
        self.authority = Authority(self.plane, orders=orders.held, out_of_use=closures.robot)
        await self.authority.start(audit.signed)
        self._stack.push_async_callback(self.authority.close)
        self.plane.on_revoked = self.authority.hold_revoked
        self._stack.callback(self.plane.events.subscribe(Stage.WATCHERS, self._on_event))

        def problems(plan: Plan) -> tuple[str, ...]:
            """What would be said of a plan if it was submitted: missions are held to it when they are uploaded."""
            roster = tuple(self.plane.registry.robots.values())
            known = {robot.id for robot in roster} >= {each.robot for each in plan.subtasks if each.robot is not None}
            context = PlanContext(
                instruction="a mission uploaded over MAVLink", robots=roster if known else None, site=site,
                out_of_use=self._out_of_use(),
            )  # fmt: skip
            return self.decomposer.review(plan, context).problems

        self._robot_tasks = RobotTasks(self.plane, config.safety)
        self.hub = RobotHub(
            config.robots,
            session=self.plane.session,
            store=self.plane.store,
            gateway=config.id,
            site=site,
            on_task=self._robot_tasks.take,
            tasks=replace(self._robot_tasks.doors(), problems=problems),
            gate=self.authority.refuses,
            roster=self.plane.registry.robots,
            keeps_ground=self._keeps_ground,
        )
        await self.hub.start()
        self._stack.push_async_callback(self.hub.stop)
        rpc = self.plane.rpc
        rpc.register(keyspace.ROBOT_LINKS, self.hub.links)
        rpc.register(keyspace.ROBOT_LINK_ADD, self.hub.add_link)
        rpc.register(keyspace.ROBOT_LINK_REMOVE, self.hub.remove_link)
        rpc.register(keyspace.ROBOT_FORGET, self.hub.forget)
        self._start_floor(site)

    def _keeps_ground(self, robot: str) -> bool:
        return self.floor.sight.knows(robot)

    def _start_floor(self, site: Site) -> None:
        config = self.config
        self.floor = FloorKeeper(
            self.plane,
            site,
            config.floor,
            voters=bool(config.plane.voters),
            takeoff_m=config.robots.takeoff_altitude_m,
            hindrance=self.authority.hindrance,
        )
        self.floor.start()
        self._stack.push_async_callback(self.floor.close)

    def _out_of_use(self) -> OutOfUse:
        kept = self.closures
        return OutOfUse(places=kept.places, robots=kept.robots, rules=kept.rules)

    def _keep_alerts(self, audit: Audit) -> None:
        if self.config.alerts.urls_file:
            self._delivery = Delivery(
                self.config.alerts,
                fleet=self.config.fleet,
                mine=self._delivers,
                alerts=lambda: self._alerts.alerts(AlertsAsk()),
                mark=self._mark_delivered,
                on_change=self._changed.set,
            )
        self._alerts = Keeper(
            self.plane,
            in_maintenance=lambda: self.closures.robots,
            on_alert=self._delivery.hear if self._delivery else None,
        )
        self._alerts.start(audit.signed)
        self._stack.push_async_callback(self._alerts.close)

    async def _mark_delivered(self, alert: Alert) -> None:
        await self._alerts.delivered(alert)

    def _delivers(self) -> bool:
        """Whether it is this gateway that delivers alerts outside."""
        return sender({**self._gateways_there(), self.config.id: self.status()}) == self.config.id

    def _gateways_there(self) -> dict[str, GatewayStatus]:
        members = self.plane.members()
        return {name: status for name, status in self.plane.registry.gateways.items() if name in members}

    async def _start_planner(self, catalogue: Catalogue) -> None:
        config, plane = self.config, self.plane

        async def ask(gateway: str, asked: ProposeAsk, timeout_s: float) -> Proposed:
            return await plane.rpc.call(gateway, keyspace.PROPOSE, asked, timeout_s=timeout_s)

        peers = PeerTier(config.llm, gateways=self._gateways_there, ask=ask, here=config.id)
        self.decomposer = Decomposer(
            config.llm, catalogue, safety=config.safety, gateway=config.id, peers=peers, check_model=self._check_model
        )  # fmt: skip
        memory = self.decomposer.memory
        await memory.load(plane.store)
        await self.decomposer.start()
        self._stack.push_async_callback(self.decomposer.close)
        hearing = plane.session.subscribe(
            plane.keys(keyspace.TASK_UPDATE),
            lambda message: None if message.deleted else memory.hear(message.key, message.payload),
        )
        self._stack.callback(hearing.close)
        plane.rpc.register(keyspace.PROPOSE, self.decomposer.propose)

    def _image_names(self, catalogue: Catalogue) -> Callable[[str], str]:
        """Return what gives the full reference of an image; each is worked out once, from what goes into it."""

        @functools.cache
        def name(image: str) -> str:
            spec = catalogue.images.get(image)
            return reference(spec, self.config.pool) if spec is not None else ""

        return name

    async def _watch_site(self, site: Site) -> None:
        """Tell where the site's file is not what is used: a broken one would keep this gateway from starting again."""
        lacking = self._site_problem
        while True:
            await asyncio.sleep(SITE_S)
            problem = await asyncio.to_thread(differs, self.config.site, site) or lacking
            if problem != self._site_problem:
                self._site_problem = problem
                log.warning("site", problem=problem or "the file is as it was loaded")
                self._changed.set()

    def _load(self) -> tuple[Catalogue, Site]:
        catalogue = load_catalogue(tuple(Path(each).expanduser() for each in self.config.skills))
        return catalogue, load_site(self.config.site)

    async def _take_parts(self, catalogue: Catalogue) -> Catalogue:
        """Take up the signed list of parts; returns the catalogue without the skills that may not run."""
        credentials = self.plane.session.credentials
        if credentials is None:
            log.warning(DEVELOPMENT)
            await self.plane.hand_on(None, keyspace.PARTS)
            return catalogue
        self._parts = InForce.beside(credentials.bundle, self.config.plane.parts_file, self._data / PARTS_FILE)
        await self.plane.hand_on(self._parts, keyspace.PARTS)
        return await asyncio.to_thread(without_unsigned, catalogue, self._parts)

    def _check_model(self, folder: Path) -> None:
        self._parts.check_folder(Kind.MODEL, folder)

    def _make_directories(self) -> None:
        for directory in (self._data, self._run_dir()):
            try:
                directory.mkdir(parents=True, exist_ok=True, mode=0o700)
            except OSError as error:
                raise ConfigError(
                    f"{directory} cannot be made: {error.strerror}",
                    remedy="set data_dir and run_dir to writable places",
                ) from error

    def _run_dir(self) -> Path:
        if self.config.run_dir:
            return Path(self.config.run_dir)
        base = os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}"
        return Path(base) / "swiftbot" / self.config.fleet / self.config.id

    async def _stop_pool(self) -> None:
        await self.pool.stop(keep_containers=self.config.keep_containers)

    async def stop(self, *, at_once: bool = False) -> None:
        """Drain, then stop every part in reverse order; `at_once`: runs are cancelled, and repeated elsewhere."""
        self._draining = self._robot_tasks.draining = True
        draining = self.migration.draining
        draining.begin(0.001 if at_once else max(0.001, self.config.drain_s), stopping=True)
        self._publish_status()
        try:
            await draining.until_empty()
            await self.executor.drain(0.0)
            await self.manager.settle(SETTLE_S)
        finally:
            await self._stack.aclose()

    def _own_load(self) -> Load:
        """What this gateway sees of itself, by which it knows that it is overloaded."""
        return Load(
            cpu=self._vitals.read().cpu_percent / 100,
            processors=float(os.cpu_count() or 1),
            squeeze=self.pool.squeeze,
            queue=self.pool.queue,
            capacity=self.config.pool.capacity,
        )

    # --- facts about this gateway ---------------------------------------------------------------------------

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, AuthorityChanged):
            self._changed.set()

    def _on_containers(self, containers: tuple[ContainerInfo, ...]) -> None:
        self.plane.registry.publish_containers(containers)
        self._changed.set()

    def _tell_decided(self, case: Struct, what: str) -> None:
        self.plane.session.put(self.plane.keys(keyspace.DECIDED, self.config.id, what), msgspec.json.encode(case))

    def _put_log(self, line: LogLine) -> None:
        line = line if line.source else replace(line, source=self.config.id)
        self._kept.hear_log(line)
        if self._observer is not None:
            self._observer.hear_log(line)
        self.plane.session.put(self.plane.keys(keyspace.LOG, self.config.id), msgspec.json.encode(line))

    def _listen_to_recorders(self) -> None:
        session, loop = self.plane.session, asyncio.get_running_loop()

        def on_token(key: str, alive: bool) -> None:
            (name,) = keyspace.RECORDER_ALIVE.names(key)
            if alive:
                self._recorders.there(name)
            else:
                loop.call_later(self._recorders.went(name, time.monotonic()) + 0.01, self._changed.set)

        self._stack.callback(session.subscribe_typed(keyspace.RECORDER_STATUS, self._hear_recorder).close)
        self._stack.callback(session.watch_alive(session.keys(keyspace.RECORDER_ALIVE), on_token).close)

    def _hear_recorder(self, _key: str, status: RecorderStatus | None) -> None:
        if status is not None and self._recorders.hear(status, time.monotonic()):
            self._changed.set()

    def _serve_operators(self, audit: Audit) -> None:
        """Answer what operators order of this gateway's pool and model."""
        rpc, verbs = self.plane.rpc, self.pool.verbs
        rpc.register(keyspace.POOL_HINT, verbs.hint)
        rpc.register(keyspace.POOL_WARM, audit.signed("pool_warm", verbs.warm))
        rpc.register(keyspace.POOL_EVICT, audit.signed("pool_evict", verbs.evict))
        release = audit.signed("pool_release_quarantine", verbs.release_quarantine)
        rpc.register(keyspace.POOL_RELEASE_QUARANTINE, release)
        rpc.register(keyspace.POOL_DECISIONS, verbs.decisions)
        rpc.register(keyspace.LLM_SWAP, audit.signed("llm_swap", self._swap_model))

    async def _swap_model(self, ask: SwapAsk) -> Swapped:
        swapped = await self.decomposer.swap(ask.folder)
        self._publish_status()
        return swapped

    def status(self) -> GatewayStatus:
        """This gateway's account of itself."""
        containers = self.pool.containers()
        capacity = self.config.pool.capacity
        vitals = self._vitals.read()
        disk_free_mb, disk_total_mb = disk_mb(self._data)
        counters = Counter[str]()
        for each in (
            self.plane.session.refused,
            self.hub.refused,
            self.pool.refused,
            self.learn.refused,
            *self._storage.refused,
        ):
            counters.update(each)
        credentials = self.plane.session.credentials
        return GatewayStatus(
            id=self.config.id,
            fleet=self.config.fleet,
            version=VERSION,
            protocol=gateways.PROTOCOL,
            oldest_protocol=gateways.OLDEST_PROTOCOL,
            load=min(1.0, max(vitals.cpu_percent / 100, self.executor.running / max(1, capacity))),
            cpu_percent=vitals.cpu_percent,
            memory_mb=vitals.memory_mb,
            disk_free_mb=disk_free_mb,
            disk_total_mb=disk_total_mb,
            capacity=capacity,
            containers=len(containers),
            ready=sum(each.state is ContainerState.READY for each in containers),
            running=self.executor.running,
            queue=self.pool.queue,
            tasks=self.manager.unfinished,
            tasks_waiting=self.manager.waiting,
            work=self.manager.scheduler.work(),
            draining=self._draining or self.executor.draining,
            drain=self.migration.draining.text,
            overloaded=self.migration.shedding.reason,
            catalogue=self.manager.scheduler.digest,
            cores=os.cpu_count() or 0,
            pool_memory_mb=self.config.pool.memory_mb,
            searches=dict(self._remote.searches),
            limits_enforced=self.pool.limits_enforced,
            pool_problem=self.pool.problem or self.pool.squeeze,
            site_problem=self._site_problem,
            keys_problem=credentials.problem(time.time()) if credentials is not None else "",
            parts=self._parts.text,
            parts_problem=self._parts.problem,
            images=self._storage.images(),
            volumes=self._storage.volumes(),
            models=self.decomposer.models,
            planner=self.decomposer.status,
            recorders=self._recorders.notes(time.monotonic()),
            delivery=self._delivery.status if self._delivery else None,
            robots=self.hub.attached,
            stops=self.authority.active[:SHOWN],
            leases=self.authority.leases[:SHOWN],
            endpoints=self.config.plane.listen,
            refused=dict(counters),
            monitor=dict(self.manager.findings),
            forgotten=self._retention.forgotten,
            started_ns=self._started_ns,
            pid=os.getpid(),
            age_ms=round((time.monotonic() - vitals.at) * 1e3),
        )

    def _publish_status(self) -> None:
        self.plane.registry.publish_status(self.status())

    async def _keep_publishing(self) -> None:
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self.config.status_s):
                    await self._changed.wait()
            self._changed.clear()
            try:
                self._publish_status()
            except Exception:  # a figure that cannot be read once must not silence this gateway for good
                log.exception("status could not be published")
            await asyncio.sleep(0.05)


async def run(config: GatewayConfig) -> None:
    """Run the daemon until SIGTERM or SIGINT; a second signal stops it at once.

    Raises:
        ConfigError: as `Gateway.start`; or another gateway of this one's id is there, and this one had to go.
        Exception: what a root task broke with.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    gateway = Gateway(config)
    await gateway.start()
    process.ready()
    supervisor = gateway.supervisor
    supervisor.start("watchdog", process.keep_alive())
    stopped = asyncio.create_task(stop.wait(), name="stopped")
    problems = [asyncio.create_task(wait) for wait in (gateway.plane.displaced(), supervisor.crashed())]
    problem: BaseException | None = None
    try:
        await asyncio.wait({stopped, *problems}, return_when=asyncio.FIRST_COMPLETED)
        if not stop.is_set():
            problem = next(task.result() for task in problems if task.done())
            log.error("this gateway stops", reason=str(problem))
    finally:
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.remove_signal_handler(number)
        process.stopping()
        try:
            # Two that answer the same questions can give nothing away in good order; nor can a gateway that broke.
            await gateway.stop(at_once=problem is not None)
        finally:
            for task in (stopped, *problems):
                task.cancel()
            # Last: draining takes a while, in which the watchdog must go on.
            await supervisor.close()
    if problem is not None:
        raise problem
