"""Tells the fleet this gateway's own facts: each when it changed, how soon and how often `cadence` decides.

What goes out says how old it is: a figure may have been read some time ago, and containers may have changed since they
were last told. A status that says nothing new is repeated now and then, and says when it will be again at the latest:
listeners can tell silence from loss.
"""

import asyncio
import time
from collections.abc import Callable

from msgspec.structs import replace

from appliance.model import ContainerInfo, GatewayStatus, encode
from appliance.plane.cadence import Cadence, Rate, heartbeat_s
from appliance.plane.session import Session

STATUS_S = 2.0
"""A status that has not changed is repeated so often in a small fleet, which costs nothing."""
LOAD_STEP = 0.05
"""A load that moved by less is no news: it changes no placement."""
MOST_IMAGES = 64
"""Images whose demand is kept apart; the oldest go."""
_MOST_TOLD = 16
_LEAST_DEMAND = 0.05


class Speaker:
    """One gateway's own facts on their way out.

    Args:
        session: to put them.
        gateway: this one.
        least_s: what changes within this time goes out together.
        most_s: nothing waits longer in a small fleet.
        listeners: how many others listen just now.
        elsewhere: decisions a second on other gateways that rest on containers of an image.
    """

    def __init__(
        self,
        session: Session,
        gateway: str,
        *,
        least_s: float,
        most_s: float,
        listeners: Callable[[], int],
        elsewhere: Callable[[str], float],
    ) -> None:
        self._session = session
        self._gateway = gateway
        self._least_s, self._most_s = least_s, most_s
        self._listeners = listeners
        self._elsewhere = elsewhere
        self._status: GatewayStatus | None = None
        self._status_at = 0.0
        self._status_told: GatewayStatus | None = None
        self._status_told_at = 0.0
        self._of_status = Cadence(least_s=least_s, most_s=most_s)
        self._wanted: dict[str, ContainerInfo] = {}
        self._told: dict[str, ContainerInfo] = {}
        self._of_image: dict[str, Cadence] = {}
        self._decisions: dict[str, Rate] = {}
        self._timer: asyncio.TimerHandle | None = None

    def status(self, status: GatewayStatus) -> None:
        """This gateway's account of itself; its `age_ms` is how old its figures are already."""
        now = time.monotonic()
        before, told = self._status, self._status_told
        self._status, self._status_at = status, now
        news = before is None or tells_more(before, status) or (told is not None and tells_more(told, status))
        if news or now - self._status_told_at >= self._again_s() - self._least_s:
            self._of_status.changed(now)
        self._plan(now)

    def containers(self, containers: tuple[ContainerInfo, ...]) -> None:
        """All containers that this gateway holds; those left out are gone."""
        now = time.monotonic()
        before, self._wanted = self._wanted, {each.id: each for each in containers}
        changed = {each.image for each in self._wanted.values() if before.get(each.id) != each}
        changed |= {each.image for each in before.values() if each.id not in self._wanted}
        for image in changed:
            self._cadence(image).changed(now)
        self._plan(now)

    def asked(self, image: str, *, here: bool) -> None:
        """A decision rests on containers of an image; one made `here` is one that the others are told of."""
        now = time.monotonic()
        self._cadence(image).asked(now)
        self._of_status.asked(now)
        if here:
            if image not in self._decisions and len(self._decisions) >= MOST_IMAGES:
                del self._decisions[next(iter(self._decisions))]
            self._decisions.setdefault(image, Rate()).add(now)

    @property
    def untold_s(self) -> float:
        """For how long containers have changed without being told."""
        since = [each.since for each in self._of_image.values() if each.since is not None]
        return time.monotonic() - min(since) if since else 0.0

    def _cadence(self, image: str) -> Cadence:
        if image not in self._of_image and len(self._of_image) >= MOST_IMAGES:
            idle = next((each for each, cadence in self._of_image.items() if cadence.since is None), None)
            if idle is not None:
                del self._of_image[idle]
        return self._of_image.setdefault(image, Cadence(least_s=self._least_s, most_s=self._most_s))

    def _again_s(self) -> float:
        return heartbeat_s(self._listeners(), STATUS_S)

    # --- going out --------------------------------------------------------------------------------------------

    def _due(self, now: float) -> dict[str, float]:
        """When which images are due; the status under the empty name."""
        listeners = self._listeners()
        due = {
            image: cadence.due(now, listeners=listeners, elsewhere=self._elsewhere(image))
            for image, cadence in self._of_image.items()
        }
        if self._status is not None:
            due[""] = self._of_status.due(now, listeners=listeners, elsewhere=self._elsewhere(""))
        return {what: at for what, at in due.items() if at is not None}

    def _plan(self, now: float) -> None:
        at = min(self._due(now).values(), default=None)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if at is not None:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, at - now), self._go)

    def _go(self, *, all_of_it: bool = False) -> None:
        self._timer = None
        now = time.monotonic()
        due = {what for what, at in self._due(now).items() if all_of_it or at <= now + self._least_s / 2}
        for image in due - {""}:
            self._tell_image(image)
            self._of_image[image].told(now)
        if "" in due:
            self._tell_status(now)
            self._of_status.told(now)
        if not all_of_it:
            self._plan(now)

    def _tell_image(self, image: str) -> None:
        session, gateway = self._session, self._gateway
        for gone in [each.id for each in self._told.values() if each.image == image and each.id not in self._wanted]:
            session.delete(session.keys.container(gateway, gone))
            del self._told[gone]
        for each in self._wanted.values():
            if each.image == image and self._told.get(each.id) != each:
                session.put(session.keys.container(gateway, each.id), encode(each))
                self._told[each.id] = each

    def _tell_status(self, now: float) -> None:
        if self._status is None:
            return
        self._status_told, self._status_told_at = self._status, now
        self._session.put(self._session.keys.status(self._gateway), encode(self.now(self._status)))

    def now(self, status: GatewayStatus) -> GatewayStatus:
        """A status as it is said at this moment: with its age, and what is asked for here."""
        now = time.monotonic()
        return replace(
            status,
            age_ms=status.age_ms + round((now - self._status_at) * 1e3),
            untold_ms=round(self.untold_s * 1e3),
            again_ms=round(self._again_s() * 1e3),
            asked=told_demand({image: rate.read(now) for image, rate in self._decisions.items()}),
        )

    def close(self) -> None:
        """Tell what waits, and no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._go(all_of_it=True)


def tells_more(before: GatewayStatus, after: GatewayStatus) -> bool:
    """Whether a status says more than slightly other figures. Pure."""
    same = replace(
        after,
        cpu_percent=before.cpu_percent,
        memory_mb=before.memory_mb,
        load=before.load,
        age_ms=before.age_ms,
        planner=before.planner,
    )
    return same != before or abs(after.load - before.load) >= LOAD_STEP


def told_demand(rates: dict[str, float]) -> dict[str, float]:
    """What is asked for most, in decisions a second, coarse so that it seldom moves. Pure."""
    coarse: dict[str, float] = {}
    for image, rate in sorted(rates.items(), key=lambda each: (-each[1], each[0]))[:_MOST_TOLD]:
        step = _LEAST_DEMAND
        while step < rate:
            step *= 2
        if rate >= _LEAST_DEMAND:
            coarse[image] = step
    return coarse
