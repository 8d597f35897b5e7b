"""Where a run that was accepted begins: in a container here, or on another gateway that has a better one.

One on another gateway is reserved and started there by the order to run itself, so that nothing lies between the choice
and the start.
"""

from collections.abc import Callable

from msgspec.structs import replace

from appliance.errors import PoolError, SwiftbotError, UnreachableError
from appliance.model import Phase, RunAccepted, RunRequest
from appliance.plane.node import Plane
from appliance.pool.pool import Pool
from appliance.pool.selection import Decision
from appliance.pool.turns import turn_of
from appliance.tasks.artifacts import bytes_by_gateway
from appliance.tasks.bounds import clean
from appliance.tasks.passing import ORDER_S, explained, may_run, passed_on
from appliance.tasks.remote import RemoteContainers

REMOTE_TRIES = 3
"""Other gateways that are tried for one run before what is here has to do."""
MAX_VERDICT = 80


class Choosing:
    """Chooses for one gateway. `check` refuses an order that must not begin any more."""

    def __init__(
        self, plane: Plane, pool: Pool, remote: RemoteContainers, *, check: Callable[[RunRequest], None]
    ) -> None:
        self._plane = plane
        self._pool = pool
        self._remote = remote
        self._check = check

    async def choose(self, request: RunRequest) -> Decision | RunAccepted:
        """Select a container; what another gateway answered, where that has taken the run.

        An offer that turns out to be nothing is counted, explained in the choice, and the next best is taken; the
        last try is without other gateways.
        """
        remote, inputs = self._remote, bytes_by_gateway(request.inputs)
        avoid = {
            **remote.left_out(),
            **self._outside(request),
            **dict.fromkeys(request.avoid, "an earlier attempt failed there"),
        }
        for left in reversed(range(REMOTE_TRIES + 1)):
            decision = await self._pool.select(
                request.need,
                allow_remote=request.hops == 0 and left > 0,
                inputs=inputs,
                avoid=avoid,
                turn=turn_of(request),
            )
            if decision.phase is not Phase.REMOTE_WARM:
                return explained(decision, avoid)
            self._check(request)
            gateway = decision.gateway
            sent = remote.promise(gateway, (request.task, request.subtask))
            try:
                accepted = await self._plane.rpc.call(
                    gateway, "run", replace(request, hops=1), RunAccepted, timeout_s=ORDER_S
                )
            except SwiftbotError as error:
                if may_run(error):
                    remote.searches["unanswered"] += 1
                    raise UnreachableError(f"{gateway} did not say whether it runs {request.run_id}") from error
                # The container was taken, or was never there, or its gateway went away meanwhile.
                remote.turned_out(sent, good=False)
                avoid = {**avoid, gateway: f"had none when asked: {clean(error.message, MAX_VERDICT)}"}
                self._plane.session.refuse("stale offer", key=gateway, run=request.run_id, reason=error.message)
            else:
                remote.turned_out(sent, good=True, container=accepted.container)
                return passed_on(accepted, explained(decision, avoid))
        raise PoolError("a selection without other gateways chose one")

    def _outside(self, request: RunRequest) -> dict[str, str]:
        """Gateways that the run may not be passed on to."""
        if not request.group:
            return {}
        return {each: "the submitter does not allow it" for each in self._plane.members() if each not in request.group}
