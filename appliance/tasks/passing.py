"""Passes runs on that were accepted here and wait for a container, and answers for them where they have gone.

The run is out of this gateway's queue before another is asked to take it, so it is in one place at any time. Taken
there, its further events are that gateway's; this one tells the coordinator where it is, and passes on questions
after it and cancels. Not taken, it goes back to its place in the queue. When it is not known whether it was taken, the
attempt has failed as `unreachable`: the next one, with a higher number, ends it wherever it is.
"""

import time
from collections.abc import Callable, Mapping

import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import DeadlineError, SwiftbotError, UnreachableError
from appliance.model import Considered, RunAccepted, RunEvent, RunEventKind, RunRequest, Way
from appliance.plane.node import Plane
from appliance.pool.books import WithdrawnError
from appliance.pool.pool import Pool
from appliance.pool.selection import MOST_CONSIDERED, Decision
from appliance.pool.turns import Turn, turn_of
from appliance.tasks.api import RunAsk, RunStatus
from appliance.tasks.bounds import MAX_NOTE, clean
from appliance.tasks.elsewhere import Elsewhere, Offer

log = structlog.get_logger(__name__)

ORDER_S = 2.0
"""How long another gateway may take to accept a run."""
PASSED_ON_S = 1.0
"""How long the gateway that a run was passed on to may take to answer a question after it."""


class PassedOn(Struct, frozen=True):
    """Another gateway has the run, and tells how it ends; `event` tells the coordinator so."""

    event: RunEvent


class Passing:
    """The runs of one gateway that wait, and those that went elsewhere while they did."""

    def __init__(self, plane: Plane, pool: Pool, elsewhere: Elsewhere) -> None:
        self._plane = plane
        self._pool = pool
        self._elsewhere = elsewhere
        self.moving: set[str] = set()
        """Runs that are being offered to another gateway: neither here nor there."""
        self.moved: dict[str, str] = {}
        """Runs that were passed on after they had been accepted here, with the gateway that has them."""

    def start(self) -> None:
        """Begin to offer those who wait; a pool that keeps to itself lets them wait."""
        if self._pool.federated:
            self._elsewhere.start()

    def stop(self) -> None:
        """Offer nothing more."""
        self._elsewhere.stop()

    async def run(
        self,
        request: RunRequest,
        decision: Decision,
        tell: Callable[[RunEvent], None],
        *,
        since: float,
        check: Callable[[RunRequest], None],
    ) -> RunEvent | PassedOn:
        """Run it here, or pass it on while it waits.

        Args:
            request: what to run.
            decision: what selection said.
            tell: gets the run's events but the last.
            since: when the order came, on the monotonic clock: its place in the queue.
            check: raises what must not begin any more.
        """
        turn = turn_of(request, since)
        try:
            return await self._here_or_there(request, decision, tell, turn, check)
        finally:
            self._elsewhere.forget(request.run_id)

    async def _here_or_there(
        self,
        request: RunRequest,
        decision: Decision,
        tell: Callable[[RunEvent], None],
        turn: Turn,
        check: Callable[[RunRequest], None],
    ) -> RunEvent | PassedOn:
        while True:
            self._elsewhere.look()
            try:
                return await self._pool.run(request, decision, tell, turn=turn)
            except WithdrawnError:
                self.moving.add(request.run_id)
            try:
                passed_on = await self._pass_on(request, self._elsewhere.offer_of(request.run_id), turn.since)
            finally:
                self.moving.discard(request.run_id)
            if passed_on is not None:
                return passed_on
            # Much may have happened meanwhile; what was reserved for it is not any more.
            check(request)
            decision = replace(decision, container=None, reservation="")

    async def _pass_on(self, request: RunRequest, offer: Offer, since: float) -> PassedOn | None:
        run_id, container = request.run_id, ""
        taken: bool | None = None
        order = replace(request, hops=1, anew=offer.anew)
        try:
            accepted = await self._plane.rpc.call(offer.gateway, "run", order, RunAccepted, timeout_s=ORDER_S)
            taken, container = True, accepted.container
        except SwiftbotError as error:
            if may_run(error):
                raise UnreachableError(f"{offer.gateway} did not say whether it runs {run_id}") from error
            taken = False
            self._plane.session.refuse("stale offer", key=offer.gateway, run=run_id, reason=error.message)
            return None
        finally:
            self._elsewhere.offered(run_id, taken=taken, container=container)
        self.moved[run_id] = accepted.gateway
        why = f"waited {time.monotonic() - since:.1f} s on {self._plane.gateway}, then {offer.why}"
        choice = accepted.choice and replace(
            accepted.choice, by=self._plane.gateway, way=Way.NEW if offer.anew else Way.RUN_THERE, why=why
        )
        return PassedOn(replace(whereabouts(request, accepted), note=clean(why, MAX_NOTE), choice=choice))

    async def ask(self, run_id: str, verb: str) -> RunStatus:
        """Ask after a run that was passed on (`run_status`), or have it ended (`run_cancel`), where it is."""
        task, subtask, number = run_id.split("/")
        ask, there = RunAsk(task=task, subtask=subtask, attempt=int(number)), self.moved[run_id]
        try:
            return await self._plane.rpc.call(there, verb, ask, RunStatus, timeout_s=PASSED_ON_S)
        except SwiftbotError as error:
            log.info("no word of a run that was passed on", run=run_id, gateway=there, reason=str(error))
            return RunStatus(running=self._plane.sees(there))


def whereabouts(request: RunRequest, accepted: RunAccepted) -> RunEvent:
    """What is told of a run that was accepted: where it is."""
    return RunEvent(
        task=request.task,
        subtask=request.subtask,
        attempt=request.attempt,
        kind=RunEventKind.PROGRESS,
        gateway=accepted.gateway,
        phase=accepted.phase,
    )


def may_run(error: SwiftbotError) -> bool:
    """Whether an order to run that ended so may have been taken: it had no answer, but may have arrived.

    The same attempt must not be begun in a second place then, for nothing fences the two off from each other. Only the
    next attempt is safe, which ends this one wherever it is.
    """
    return isinstance(error, DeadlineError) or (isinstance(error, UnreachableError) and error.sent)


def explained(decision: Decision, avoid: Mapping[str, str]) -> Decision:
    """Have the choice name the gateways that were left out, also those that selection did not hear of again."""
    choice = decision.choice
    if choice is None or not avoid:
        return decision
    told = {each.gateway for each in choice.considered}
    missing = tuple(
        Considered(gateway=gateway, way=Way.RUN_THERE, verdict=reason)
        for gateway, reason in avoid.items()
        if gateway not in told
    )
    considered = (*choice.considered[: MOST_CONSIDERED - len(missing)], *missing)
    return replace(decision, choice=replace(choice, considered=considered[:MOST_CONSIDERED]))


def passed_on(accepted: RunAccepted, decision: Decision) -> RunAccepted:
    """The other gateway's answer with the reasons of the one that chose it; it picks the container itself."""
    choice = decision.choice
    if choice is None:
        return accepted
    choice = replace(choice, gateway=accepted.gateway, container=accepted.container)
    if accepted.choice is not None and accepted.choice.way is Way.BRING_HERE:
        choice = replace(choice, why=f"{choice.why}; there {accepted.choice.why}")
    return replace(accepted, why=decision.why, choice=choice)
