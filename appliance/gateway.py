"""Composition root of the daemon: builds the parts, starts them in order, watches them, stops them in reverse.

Order: plane (others can find us) → language model → robots → pool → tasks; the gateway takes part in the ring
from the first step but accepts runs only when its pool is there. On SIGTERM: say that we drain, let runs end,
hand over coordination (the next owner of each key goes on), leave the warm containers for the next start.

State volumes and images (`StateHere`): their parts are the pool's (`pool.volumes`, `pool.transfer`); here they are
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
from typing import Any

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance import logs, process
from appliance.config import GatewayConfig
from appliance.errors import ConfigError, PrerequisiteError
from appliance.llm.api import SwapAsk, Swapped
from appliance.llm.cascade import Decomposer
from appliance.llm.checks.safety import strictest
from appliance.llm.peers import PeerTier, ProposeAsk, Proposed
from appliance.llm.settings import PlanContext
from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    LogLine,
    Need,
    Plan,
    PoolHint,
    RobotInfo,
    RunRequest,
    Site,
    VolumeInfo,
)
from appliance.plane.node import Plane
from appliance.pool.api import DecisionsAsk, EvictAsk, ReleaseAsk, WarmAsk
from appliance.pool.engine import PodmanStorage
from appliance.pool.images import reference
from appliance.pool.pool import Call, Pool
from appliance.pool.settings import PoolConfig
from appliance.pool.state import ALONE, State
from appliance.pool.transfer.transfers import Transfers
from appliance.pool.volumes import Volumes
from appliance.process import Vitals
from appliance.record.models import Recorders, RecorderStatus
from appliance.robot_tasks import RobotTasks
from appliance.robots.api import LinkAdd, LinkRemove, LinksAsk, RobotForget
from appliance.robots.authority.authority import SHOWN, Authority
from appliance.robots.hub import RobotHub
from appliance.robots.limits import Bounds, Orders, Usual
from appliance.skills.catalogue import Catalogue, load_catalogue
from appliance.skills.sites import load_site
from appliance.tasks.api import ArtifactAsk, RunAsk, SiteAsk, TaskLinesAsk
from appliance.tasks.artifacts import Artifacts
from appliance.tasks.audit import Audit
from appliance.tasks.enquiries import Enquiries
from appliance.tasks.executor import Executor
from appliance.tasks.handler_calls import Calls
from appliance.tasks.manager import TaskManager
from appliance.tasks.migration.gateway import Migration
from appliance.tasks.migration.handoff import Leaving
from appliance.tasks.migration.policy import Load
from appliance.tasks.offload import Links, RemoteContainers, UnmeasuredLinks
from appliance.tasks.retention import Retention
from appliance.tasks.stream import Kept


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
        self, config: PoolConfig, *, plane: Plane, fleet: str, data_dir: Path, on_change: Callable[[], None]
    ) -> None:
        self.state: State = ALONE
        """What the pool may do with state; nothing without Podman."""
        self.links: Links = UnmeasuredLinks()
        """How fast others are reached."""
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
            storage = PodmanStorage(self._config.podman_url)
        except PrerequisiteError as error:
            log.warning("state volumes and images cannot be moved", reason=str(error))
            return

        async def let_go() -> None:
            await asyncio.to_thread(storage.close)

        self._stack.push_async_callback(let_go)
        plane, settings = self._plane, self._config.transfer
        self._volumes = volumes = Volumes(
            settings, fleet=self._fleet, gateway=plane.gateway, store=plane.store, records=plane.dht, storage=storage
        )
        await volumes.start()
        self._stack.push_async_callback(volumes.close)
        volumes.on_change = self._on_change
        plane.registry.on_change.append(self._hear_of_volumes)
        plane.on_member_lost.append(lambda gateway: volumes.hear(gateway, ()))
        self._transfers = transfers = Transfers(
            settings, plane=plane, volumes=volumes, storage=storage, data_dir=self._data
        )
        await transfers.start(signed)
        self._stack.push_async_callback(transfers.close)
        transfers.on_change = self._on_change
        self.state = State(
            bring=transfers.bring_newest,
            use=volumes.use,
            newest_here=volumes.newest_here,
            bring_image=transfers.bring_image,
        )
        self.links = transfers

    def _hear_of_volumes(self, what: str) -> None:
        if what == "gateway" and self._volumes is not None:
            for gateway, status in self._plane.registry.gateways.items():
                if gateway != self._plane.gateway:
                    self._volumes.hear(gateway, status.volumes)

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


VERSION = "0.1.0"
SETTLE_S = 3.0
"""How long a draining gateway waits for the ends of its runs to be written: a replicated write takes milliseconds."""


class Gateway:
    """One gateway. `start` and `stop` do all; `run` is the daemon around them."""

    def __init__(self, config: GatewayConfig) -> None:
        self.config = config
        self._data = Path(config.data_dir).expanduser()
        self._started_ns = time.time_ns()
        self._stack = contextlib.AsyncExitStack()
        self._vitals = Vitals()
        self._changed = asyncio.Event()
        self._draining = False
        self._kept = Kept(config.id)
        """The last lines about tasks that this gateway has said."""
        self._site_problem = ""
        self._recorders = Recorders()

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
        self.plane = await Plane.open(config.plane, fleet=config.fleet, gateway=config.id, data_dir=self._data)
        self._stack.push_async_callback(self.plane.close)
        logs.publish_to(self._put_log)
        self._stack.callback(logs.publish_to, None)
        await self.plane.until_back()

        await self._start_planner(catalogue)

        recorders = self.plane.session.subscribe_typed(
            self.plane.keys.recorder_status(), RecorderStatus, self._hear_recorder
        )
        self._stack.callback(recorders.close)

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
        enquiries = Enquiries(self.plane)
        enquiries.start(audit)
        self._stack.push_async_callback(enquiries.close)
        calls = Calls(
            self.plane,
            artifacts,
            on_wait=self._on_wait,
            hindrance=self.authority.hindrance,
            enquiries=enquiries,
            orders=orders.held,
        )
        self._storage = storage = StateHere(
            config.pool, plane=self.plane, fleet=config.fleet, data_dir=self._data, on_change=self._changed.set
        )
        self._stack.push_async_callback(storage.close)
        await storage.open(audit.signed)
        self._remote = remote = RemoteContainers(
            self.plane, successors=config.plane.find_successors, links=storage.links
        )

        async def on_call(call: Call) -> dict[str, object]:
            return await self._leaving.guard(call, calls)

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
            on_call=on_call,
            on_change=self._on_containers,
            state=storage.state,
            store=self.plane.store,
            on_decided=self._tell_decided,
        )
        self.executor = Executor(self.plane, self.pool, remote, config.tasks)
        self.executor.on_change = self._changed.set
        self._leaving = Leaving(config.id, self.executor, skills=catalogue.skills, config=config.tasks.migration)
        self.executor.telling.on_told = self._kept.hear_event
        await self.executor.start()
        await self.pool.start()
        self._stack.push_async_callback(self._stop_pool)

        rpc = self.plane.rpc
        rpc.register("run", RunRequest, self.executor.run)
        rpc.register("run_status", RunAsk, self.executor.status)
        rpc.register("run_cancel", RunAsk, self.executor.cancel)
        rpc.register("artifact", ArtifactAsk, artifacts.piece)

        async def tell_site(_: SiteAsk) -> Site:
            return site

        rpc.register("site", SiteAsk, tell_site)
        rpc.register("find_containers", Need, remote.answer)
        self._serve_operators(audit)

        self.manager = TaskManager(
            config.tasks,
            plane=self.plane,
            catalogue=catalogue,
            decomposer=self.decomposer,
            executor=self.executor,
            site=site,
            image_of=self._image_names(catalogue),
            commands=self.authority,
            audit=audit,
        )
        self.manager.on_change = self._changed.set
        self.authority.on_change.append(self.manager.look_again)
        self.manager.recovery.on_published = self._kept.hear_transition
        rpc.register("task_lines", TaskLinesAsk, self._kept.answer)
        await self.manager.start()
        self._stack.push_async_callback(self.manager.stop)
        self.migration = Migration(
            self.plane,
            self.pool,
            executor=self.executor,
            leaving=self._leaving,
            tasks=self.manager,
            config=config.tasks.migration,
            load=self._own_load,
            volumes_mb=storage.volumes_mb,
            on_change=self._changed.set,
            audit=audit,
        )
        self.migration.start()
        self._stack.push_async_callback(self.migration.close)
        self._robot_tasks.open(self.manager)
        self._stack.callback(self._robot_tasks.close)
        self._retention = Retention(self.plane, config.tasks)
        self._publish_status()
        for work in (self._keep_publishing(), self._retention.run()):
            self._stack.callback(asyncio.create_task(work, name=work.__qualname__).cancel)
        log.info("gateway is up", gateway=config.id, fleet=config.fleet, pid=os.getpid())

    async def _start_robots(self, site: Site, audit: Audit, orders: Orders) -> None:
        config = self.config
        self.authority = Authority(self.plane, orders=orders.held)
        await self.authority.start(audit.signed)
        self._stack.push_async_callback(self.authority.close)
        self.authority.on_change.append(self._changed.set)

        def problems(plan: Plan) -> tuple[str, ...]:
            """What would be said of a plan if it was submitted: missions are held to it when they are uploaded."""
            roster = tuple(self.plane.registry.robots.values())
            known = {robot.id for robot in roster} >= {each.robot for each in plan.subtasks if each.robot is not None}
            context = PlanContext(
                instruction="a mission uploaded over MAVLink", robots=roster if known else None, site=site
            )
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
        )
        await self.hub.start()
        self._stack.push_async_callback(self.hub.stop)
        rpc = self.plane.rpc
        rpc.register("robot_links", LinksAsk, self.hub.links)
        rpc.register("robot_link_add", LinkAdd, self.hub.add_link)
        rpc.register("robot_link_remove", LinkRemove, self.hub.remove_link)
        rpc.register("robot_forget", RobotForget, self.hub.forget)

    async def _start_planner(self, catalogue: Catalogue) -> None:
        config, plane = self.config, self.plane

        async def ask(gateway: str, asked: ProposeAsk, timeout_s: float) -> Proposed:
            return await plane.rpc.call(gateway, "propose", asked, Proposed, timeout_s=timeout_s)

        def gateways() -> dict[str, GatewayStatus]:
            members = plane.members()
            return {name: status for name, status in plane.registry.gateways.items() if name in members}

        peers = PeerTier(config.llm, gateways=gateways, ask=ask, here=config.id)
        self.decomposer = Decomposer(
            config.llm, catalogue, safety=config.safety, gateway=config.id, peers=peers
        )  # fmt: skip
        memory = self.decomposer.memory
        await memory.load(plane.store)
        await self.decomposer.start()
        self._stack.push_async_callback(self.decomposer.close)
        hearing = plane.session.subscribe(
            plane.keys.task(), lambda message: None if message.deleted else memory.hear(message.key, message.payload)
        )
        self._stack.callback(hearing.close)
        plane.rpc.register("propose", ProposeAsk, self.decomposer.propose)

    def _image_names(self, catalogue: Catalogue) -> Callable[[str], str]:
        """Return what gives the full reference of an image; each is worked out once, from what goes into it."""

        @functools.cache
        def name(image: str) -> str:
            spec = catalogue.images.get(image)
            return reference(spec, self.config.pool) if spec is not None else ""

        return name

    def _load(self) -> tuple[Catalogue, Site]:
        catalogue = load_catalogue(tuple(Path(each).expanduser() for each in self.config.skills))
        return catalogue, load_site(self.config.site)

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

    def _on_containers(self, containers: tuple[ContainerInfo, ...]) -> None:
        self.plane.registry.publish_containers(containers)
        self._changed.set()

    def _tell_decided(self, case: Struct, what: str) -> None:
        self.plane.session.put(self.plane.keys.decided(self.config.id, what), msgspec.json.encode(case))

    def _put_log(self, line: LogLine) -> None:
        line = line if line.source else replace(line, source=self.config.id)
        self._kept.hear_log(line)
        self.plane.session.put(self.plane.keys.log(self.config.id), msgspec.json.encode(line))

    def _hear_recorder(self, _key: str, status: RecorderStatus | None) -> None:
        if status is not None and self._recorders.hear(status, time.monotonic()):
            self._changed.set()

    def _serve_operators(self, audit: Audit) -> None:
        """Answer what operators order of this gateway's pool and model."""
        rpc, verbs = self.plane.rpc, self.pool.verbs
        rpc.register("pool_hint", PoolHint, verbs.hint)
        rpc.register("pool_warm", WarmAsk, audit.signed("pool_warm", verbs.warm))
        rpc.register("pool_evict", EvictAsk, audit.signed("pool_evict", verbs.evict))
        release = audit.signed("pool_release_quarantine", verbs.release_quarantine)
        rpc.register("pool_release_quarantine", ReleaseAsk, release)
        rpc.register("pool_decisions", DecisionsAsk, verbs.decisions)
        rpc.register("llm_swap", SwapAsk, audit.signed("llm_swap", self._swap_model))

    async def _swap_model(self, ask: SwapAsk) -> Swapped:
        swapped = await self.decomposer.swap(ask.folder)
        self._publish_status()
        return swapped

    def _on_wait(self, call: Call, note: str) -> None:
        self.executor.waits(call, note)

    def status(self) -> GatewayStatus:
        """This gateway's account of itself."""
        containers = self.pool.containers()
        capacity = self.config.pool.capacity
        vitals = self._vitals.read()
        counters = Counter[str]()
        for each in (self.plane.session.refused, self.hub.refused, self.pool.refused, *self._storage.refused):
            counters.update(each)
        return GatewayStatus(
            id=self.config.id,
            fleet=self.config.fleet,
            version=VERSION,
            load=min(1.0, max(vitals.cpu_percent / 100, self.executor.running / max(1, capacity))),
            cpu_percent=vitals.cpu_percent,
            memory_mb=vitals.memory_mb,
            capacity=capacity,
            containers=len(containers),
            ready=sum(each.state is ContainerState.READY for each in containers),
            running=self.executor.running,
            queue=self.pool.queue,
            tasks=self.manager.unfinished,
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
            images=self._storage.images(),
            volumes=self._storage.volumes(),
            models=self.decomposer.models,
            planner=self.decomposer.status,
            recorders=self._recorders.notes(time.monotonic()),
            robots=self.hub.attached,
            stops=self.authority.active[:SHOWN],
            leases=self.authority.leases[:SHOWN],
            endpoints=self.config.plane.listen,
            refused=dict(counters),
            monitor=dict(self.manager.recovery.counts),
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
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    gateway = Gateway(config)
    await gateway.start()
    process.ready()
    watchdog = asyncio.create_task(process.keep_alive(), name="watchdog")
    stopped = asyncio.create_task(stop.wait(), name="stopped")
    displaced = asyncio.create_task(gateway.plane.displaced(), name="displaced")
    problem: ConfigError | None = None
    try:
        await asyncio.wait({stopped, displaced}, return_when=asyncio.FIRST_COMPLETED)
        if not stop.is_set():
            problem = displaced.result()
            log.error("this gateway stops: its id is another's", reason=str(problem))
    finally:
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.remove_signal_handler(number)
        process.stopping()
        try:
            # Two that answer the same questions can give nothing away in good order.
            await gateway.stop(at_once=problem is not None)
        finally:
            # Draining takes a while, in which the loop must go on being seen to turn.
            for each in (watchdog, stopped, displaced):
                each.cancel()
    if problem is not None:
        raise problem
