"""What the policies are told and shown of this gateway's pool, and what their answers mean here.

It exists between the keeper, which starts and ends containers, and the planner, which is plain code and knows neither
books nor memory nor clock: whether there is room, for what somebody would have to go, why nothing more can be started,
and how long a run would wait.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable

import msgspec

from appliance.errors import PoolError, RefusedError
from appliance.model import Need, PoolHint
from appliance.pool.books import Books
from appliance.pool.experience import Experience
from appliance.pool.glance import glance
from appliance.pool.link import EngineLink
from appliance.pool.policies import Idle, Planner, Retire, Start, View
from appliance.pool.policies.planner import Weighed
from appliance.pool.pressure import MemoryWatch, Reading
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter
from appliance.pool.starts import Starts
from appliance.pool.turns import Completions, Turn


class Planning:
    """The planner of one gateway's pool with what it goes by.

    Args:
        config: section `[pool]`.
        gateway: this gateway's id.
        images: all images of the catalogue.
        books: who has which container.
        starts: starts in progress, and images in quarantine.
        starter: knows how large a container of an image is.
        link: Podman.
        on_change: called when there is something new to plan for.
        refused: counts what is declined.
        read_memory: what the kernel says of memory, unless a test says otherwise.
    """

    def __init__(
        self,
        config: PoolConfig,
        *,
        gateway: str,
        images: Iterable[str],
        books: Books,
        starts: Starts,
        starter: Starter,
        link: EngineLink,
        on_change: Callable[[], None],
        refused: Counter[str],
        read_memory: Callable[[], Reading] | None = None,
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._images = tuple(images)
        self._books = books
        self._starts = starts
        self._starter = starter
        self._link = link
        self._on_change = on_change
        self._refused = refused
        self._completions = Completions()
        self._planner = Planner(
            config.baseline(), starts.costs, lambda image: starter.size(image).memory_mb, hour=_hour
        )
        self.memory = MemoryWatch(
            config.pressure,
            memory_mb=config.memory_mb,
            held_mb=lambda: books.memory_mb,
            on_change=on_change,
            read=read_memory,
        )

    # --- what happens -----------------------------------------------------------------------------------------

    def hinted(self, hint: PoolHint) -> None:
        """Note what will be needed here."""
        self._planner.hinted(hint, time.monotonic())
        self._on_change()

    def arrived(self, image: str) -> None:
        """Note that a run begins here, or waits for a container."""
        self._planner.arrived(image, time.monotonic())

    def ended(self, image: str, held_s: float) -> None:
        """Note that a run that had arrived is over, having had its container for so long (0: it had none)."""
        if held_s > 0:
            self._completions.ended(held_s)
        self._planner.ended(image, held_s, time.monotonic())

    def evicted(self, idle: Idle) -> None:
        """Note that a container `make_room` named was given up."""
        self._planner.evicted(idle, time.monotonic())

    def experience(self) -> Experience:
        """Return what was learned, to be kept."""
        return Experience(cold_ms=self._starts.costs.state(), planner=self._planner.state())

    def recall(self, experience: Experience) -> None:
        """Go on from what was learned before a restart; images that are gone are forgotten."""
        known = set(self._images)
        cold_ms = {image: seen for image, seen in experience.cold_ms.items() if image in known}
        demand = {image: each for image, each in experience.planner.demand.items() if image in known}
        self._starts.costs.restore(cold_ms)
        self._planner.restore(msgspec.structs.replace(experience.planner, demand=demand), time.monotonic())

    # --- what there is ----------------------------------------------------------------------------------------

    @property
    def squeeze(self) -> str:
        """Why the pool holds less than it is allowed, when the machine is short of memory; empty otherwise."""
        squeeze = self.memory.squeeze
        return squeeze.reason and f"{squeeze.reason}: {squeeze.budget_mb} of {self._config.memory_mb} MB for containers"

    def _view(self) -> View:
        """Return what there is, as the planner sees it."""
        return glance(
            self._books,
            self._starts.costs,
            now=time.monotonic(),
            budget_mb=self.memory.squeeze.budget_mb,
            capacity=self._config.capacity,
            blocked=self._starts.problems(self._images),
        )

    def expected_s(self, position: int) -> float | None:
        """In how many seconds the run at a place in the queue (from 1) may have a container; None: not known."""
        return self._completions.expected_s(position, len(self._books))

    # --- room -------------------------------------------------------------------------------------------------

    def size_mb(self, need: Need) -> int:
        """Memory of a container for a need."""
        return self._starter.size(need.image, need).memory_mb

    def _room(self, memory_mb: int, *, for_run: bool) -> tuple[Retire, ...] | None:
        """Return whom to give up for a container of this size; None when there is no room."""
        return self._planner.room(self._view(), memory_mb, time.monotonic(), for_run=for_run)

    def has_room(self, need: Need) -> bool:
        """Whether there is room for one more container, if need be in place of an idle one."""
        return self._room(self.size_mb(need), for_run=True) is not None

    def make_room(self, need: Need) -> tuple[tuple[Idle, str], ...] | None:
        """Return whom a run's new container takes the place of, each with why; None when there is no room."""
        view = self._view()
        victims = self._planner.room(view, self.size_mb(need), time.monotonic(), for_run=True)
        if victims is None:
            return None
        idle = {each.id: each for each in view.idle}
        return tuple((idle[each.id], each.why) for each in victims)

    @property
    def weighed(self) -> Weighed | None:
        """What the last room for a run was made from, where it took the place of something."""
        return self._planner.weighed

    def tend(self, now: float) -> tuple[tuple[Start, ...], tuple[Retire, ...]]:
        """Return what to start ahead and what to give up, to be carried out together, retirements first."""
        return self._planner.tend(self._view(), now)

    # --- what cannot be ---------------------------------------------------------------------------------------

    def check_startable(self, need: Need, turn: Turn | None = None) -> None:
        """Raise when a cold start now would be in vain.

        Raises:
            PoolError: Podman is away.
            RefusedError: the image does not start, or everything is busy and too many wait.
        """
        self.check_image(need.image)
        if self._books.queue >= self._config.queue and not self.has_room(need):
            # A full queue turns away whoever would be served last, which need not be the one who comes.
            if turn is not None and self._books.queue and not self._books.would_be_last(turn):
                return
            self._refused["queue full"] += 1
            raise self.full()

    def check_image(self, image: str) -> None:
        """Raise PoolError when Podman is away, RefusedError when the image does not start."""
        if self._link.problem:
            raise PoolError(self._link.problem, remedy="swiftbot doctor tells more")
        if reason := self._starts.why_not(image):
            self._refused["quarantined image"] += 1
            raise RefusedError(reason, remedy="swiftbot images build, then swiftbot pool release")

    def full(self) -> RefusedError:
        """Return what is told to one for whom there is no place in the queue."""
        after_s = self.expected_s(self._books.queue + 1)
        when = "wait" if after_s is None else f"ask again in about {after_s:.1f} s"
        return RefusedError(
            f"all {len(self._books)} containers of {self._gateway} are busy and {self._books.queue} runs wait"
            + (f"; {self.squeeze}" if self.squeeze else ""),
            remedy=f"{when}, or raise pool.capacity",
            retry_after_s=after_s or 0.0,
        )

    def why_no_start(self, image: str) -> str:
        """Return why one more container of an image cannot be started ahead now; empty when it can."""
        if reason := self._link.problem or self._starts.why_not(image):
            return reason
        size_mb = self._starter.size(image).memory_mb
        victims = self._room(size_mb, for_run=False)
        if victims is not None and not any(self._image_of(each) == image for each in victims):
            return ""
        holders = Counter(f"{each.info.state} {each.info.image}" for each in self._books)
        return (
            f"no room for one more {image} container ({size_mb} MB): {len(self._books)} of {self._config.capacity}"
            f" places and {self._books.memory_mb} of {self.memory.squeeze.budget_mb} MB are taken by "
            + ", ".join(f"{count} {what}" for what, count in sorted(holders.items()))
            + (f"; {self.squeeze}" if self.squeeze else "")
        )

    def _image_of(self, retirement: Retire) -> str:
        container = self._books.get(retirement.id)
        return container.info.image if container is not None else ""


def _hour(now: float) -> float:
    """Return the hour of the day (UTC) at a reading of the monotonic clock: what people do follows it."""
    return (time.time() - (time.monotonic() - now)) / 3600.0 % 24.0
