"""Anti-entropy: every gateway fetches from the others what it should hold and does not.

Runs when the membership changes (a joiner gets the records it now owns, the next replica those of a dead one) and
every few seconds besides. `steps` decides for which ring and with whom, `comparing` compares, `handover` gives away
what belongs elsewhere. What can wait never holds up what cannot: a round at rest, copies to be handed over and a
comparison with somebody who has come are given up when a member is lost, whose keys somebody waits for.
"""

import asyncio
import contextlib
import random
import time
from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

import structlog

from appliance.plane.absence import GONE_S
from appliance.plane.comparing import Comparing
from appliance.plane.dht import Dht
from appliance.plane.handover import HandOver
from appliance.plane.membership import Membership
from appliance.plane.pulse import Pulse, Standstill
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.steps import FEW, Kind, Settled, Step, Steps
from appliance.plane.store import Store

log = structlog.get_logger(__name__)

LOSS_S = 0.5
"""How long a lost member's keys wait for all who may have something newer of them. With the writes that follow, which
wait `replica_timeout_s` for the same silent member, its tasks are taken over within a second of its loss being noticed.
Whoever has not told by then is asked again at once, and what it has is news."""
_AGAIN_S = 1.0
"""After a member could not be compared with."""
_SOON_S = 0.1
"""The same while requests wait for the comparison."""
_TRIES = 3
"""Comparisons with a new ring before this gateway goes on without a member that is seen but does not answer."""
_ARRIVAL_S = (0.1, 0.3)
"""Before whoever has come is compared with, drawn: it is given to find its own records first, and the others do not all
ask it at one moment. Several that come at once are one step."""
_ARRIVALS = 500.0
"""And longer by one second for so many members: the more there are, the more come at once."""


class _Done(NamedTuple):
    heard: bool = True
    """Whether all that were asked have answered."""
    handed: bool = True
    """Whether nothing is here any more that belongs elsewhere."""
    fetched: int = 0


class Reconciler:
    """Keeps one gateway's shard in step with the others'."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        dht: Dht,
        pulse: Pulse,
    ) -> None:
        self._config = config
        self._rpc = rpc
        self._membership = membership
        self._dht = dht
        self._pulse = pulse
        self._steps = Steps(gateway, replicas=config.replicas)
        self._comparing = Comparing(config, gateway=gateway, store=store, rpc=rpc, membership=membership, keep=dht.keep)
        self._hand_over = HandOver(config, gateway=gateway, store=store, rpc=rpc, membership=membership)
        self._changed = asyncio.Event()
        self._hurry = asyncio.Event()
        """Something has happened that a round under way may have to be given up for."""
        self._lost: dict[str, float] = {}
        """Member that was lost -> until when it is asked whether it is there after all, for as long as that counts."""
        self._lost_at: float | None = None
        """When the first member was lost that the shard is not settled without."""
        self._running: asyncio.Task[None] | None = None
        self._wanted = asyncio.Event()
        """A request waits for the shard to be reconciled."""
        dht.settling.on_wanted = self._wanted.set
        membership.on_joined.append(self._on_joined)
        membership.on_lost.append(self._on_lost)
        pulse.on_stalled.append(self._on_stalled)

    def start(self) -> None:
        """Reconcile now, at every change of membership, and every `anti_entropy_s`."""
        self._changed.set()
        self._running = asyncio.create_task(self._run(), name="reconcile")

    def _on_joined(self, name: str) -> None:
        if self._steps.met(name):
            self._dht.settling.returned |= {name}
        self._changed.set()

    def _on_lost(self, name: str) -> None:
        self._dht.settling.returned -= {name}
        now = time.monotonic()
        self._lost[name] = now + GONE_S
        self._dht.absence.lost(name, now)
        self._lost_at = now if self._lost_at is None else self._lost_at
        self._changed.set()
        self._hurry.set()

    def _on_stalled(self, _: Standstill) -> None:
        self._changed.set()
        self._hurry.set()

    async def _run(self) -> None:
        while True:
            try:
                await self._step_by_step()
            except Exception as error:  # supervision boundary: a gateway that never compares again loses records
                log.exception("reconciling broke off and begins anew")
                self._rpc.refuse("reconciling broke off", reason=f"{type(error).__name__}: {error}")
            await asyncio.sleep(_AGAIN_S)

    async def _step_by_step(self) -> None:
        settled: Settled | None = None
        tries, wait_s = 0, 0.0
        tidy, handed, waited = False, True, False
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._changed.wait()
            self._changed.clear()
            self._hurry.clear()
            if not self._dht.settling.returned:
                self._wanted.clear()
            step = self._steps.next(settled, self._membership.ring, self._pulse.stalls)
            if step.kind is Kind.ARRIVAL and not waited:
                await self._let_arrive(step)
                waited, wait_s = True, 0.0
                continue
            waited = False
            if step.kind in (Kind.LOSS, Kind.ARRIVAL) and not step.asked:
                # Others' keys moved. What may have to be handed over waits until a burst of such news is over.
                settled = await self._settle(step, _Done())
                tries, tidy = 0, True
                wait_s = _AGAIN_S if step.ring == self._membership.ring else 0.0
                continue
            try:
                done = await self._unless_urgent(self._round(step, tidy=tidy), step)
            except Exception:  # supervision boundary: repair must go on whatever one round ran into
                log.exception("reconciling failed")
                done = _Done(heard=False, handed=False)
                if step.kind is not Kind.REST:
                    self._dht.absence.asked(step.asked, self._membership.members & frozenset(step.asked))
            if done is None:
                tries, wait_s = 0, 0.0
                continue
            if step.kind is Kind.REST:
                handed = done.handed
                # Spread, so that a fleet that settled at one moment does not compare at one moment ever after.
                rest_s = self._config.anti_entropy_s * random.uniform(0.75, 1.25)  # noqa: S311
                wait_s, tidy = rest_s if done.heard and handed else _AGAIN_S, False
                if done.fetched:
                    # A member that could not be asked when the ring changed was heard only now: same news.
                    self._tell(self._dht.on_ring_change)
                continue
            tries += 1
            if not done.heard and tries < _TRIES and step.kind is not Kind.LOSS:
                wait_s = _SOON_S
                continue
            if step.stalls == self._pulse.stalls:
                settled = await self._settle(step, done)
            # What belongs elsewhere is handed over next: nobody waits for that.
            tries, tidy = 0, done.heard
            wait_s = _SOON_S if step.ring == self._membership.ring else 0.0

    async def _let_arrive(self, step: Step) -> None:
        """Wait a moment for more that come, unless somebody waits for what they bring, or is lost."""
        for_s = random.uniform(*_ARRIVAL_S) + len(step.ring.members) / _ARRIVALS  # noqa: S311 - spreads load
        waits = [asyncio.create_task(each.wait()) for each in (self._hurry, self._wanted)]
        try:
            await asyncio.wait(waits, timeout=for_s, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for each in waits:
                each.cancel()

    async def _round(self, step: Step, *, tidy: bool) -> _Done:
        absence = self._dht.absence
        if step.kind is not Kind.REST:
            # A member that is silent already is not waited for again while somebody waits for a lost one's keys.
            loss = step.kind is Kind.LOSS
            asked = [each for each in step.asked if not (loss and each in absence.silent)]
            compared = await self._comparing.compare(step.ring, asked, within_s=LOSS_S if loss else None)
            absence.asked(asked, compared.silent)
            return _Done(heard=absence.silent.isdisjoint(step.asked), fetched=compared.fetched)
        asked = sorted({*(() if tidy else step.asked), *(absence.silent & step.ring.members)})
        compared = await self._comparing.compare(step.ring, asked)
        absence.heard(set(asked) - compared.silent)
        now = time.monotonic()
        if not tidy and not compared.silent and step.ring == self._membership.ring:
            absence.calm(step.ring, now)
        handed = await self._hand_over.run(step.ring)
        members = self._membership.members
        self._lost = {name: until for name, until in self._lost.items() if until > now and name not in members}
        await asyncio.gather(*(self._comparing.sees(name) for name in self._lost))
        return _Done(not compared.silent, handed, compared.fetched)

    async def _unless_urgent(self, work: Coroutine[Any, Any, _Done], step: Step) -> _Done | None:
        """Do a round; None when it was given up for something that cannot wait for it."""
        task = asyncio.create_task(work)
        try:
            while not task.done():
                hurry = asyncio.create_task(self._hurry.wait())
                try:
                    await asyncio.wait({task, hurry}, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    hurry.cancel()
                self._hurry.clear()
                if not task.done() and self._steps.urgent(step, self._membership.members, self._pulse.stalls):
                    return None
            return task.result()
        finally:
            if not task.done():
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)

    async def _settle(self, step: Step, done: _Done) -> Settled:
        settled = self._steps.settled(step)
        self._dht.settling.returned -= step.ring.members
        self._dht.absence.settled(step.ring)
        await self._dht.settling.settled(step.ring, step.stalls)
        fields: dict[str, Any] = {}
        if step.kind is Kind.LOSS and self._lost_at is not None:
            fields["after_loss_ms"] = round((time.monotonic() - self._lost_at) * 1e3, 1)
        if step.ring.members >= self._membership.members:
            self._lost_at = None
        log.info(
            "shard settled", why=str(step.kind), members=len(step.ring.members), asked=len(step.asked),
            heard=done.heard, fetched=done.fetched, **fields,
        )  # fmt: skip
        self._tell(self._dht.on_ring_change)
        return settled

    def _tell(self, callbacks: list[Callable[[], None]]) -> None:
        for callback in tuple(callbacks):
            try:
                callback()
            except Exception:  # supervision boundary: one listener's defect must not stop the repair
                log.exception("a listener to the ring failed")

    async def join(self) -> None:
        """Fetch what this gateway will own before it shows itself, so that its first requests wait less.

        In a large fleet each of many has little of it, and asking all twice takes longer than it saves.
        """
        ring = self._membership.ring
        near = sorted(self._steps.sharing(ring))
        if len(near) <= FEW:
            await self._comparing.compare(ring, near, joining=True)

    async def give_all(self) -> None:
        """Give everything that is here to the others."""
        log.info("gave all records to the others", records=await self._hand_over.give_all())

    async def close(self) -> None:
        """Stop reconciling."""
        if self._running is not None:
            self._running.cancel()
            await asyncio.gather(self._running, return_exceptions=True)
        await self._comparing.close()
