"""The tier of gateways without a model: asks one that has. Any gateway can decompose, whatever it holds itself.

Who has a model is in each gateway's status. The least loaded is asked first, then another; one that failed is left
alone for a while. What comes back is a proposal like any other: the asking gateway checks it against its own roster,
site and policy, and nothing that a peer says can widen them.
"""

import time
from collections.abc import Awaitable, Callable, Mapping

import structlog

from appliance.errors import DeadlineError, PlanError, SwiftbotError, UnreachableError
from appliance.llm.routing import Breaker
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.llm.tier import Proposal
from appliance.model import GatewayStatus, Plan, Tier
from appliance.model.planner_api import ProposeAsk, Proposed

log = structlog.get_logger(__name__)


Ask = Callable[[str, ProposeAsk, float], Awaitable[Proposed]]
"""Asks a gateway, within so many seconds."""


def candidates(gateways: Mapping[str, GatewayStatus], *, here: str) -> list[str]:
    """Return the other gateways that have a local model ready, the least busy first. Pure."""
    found: list[tuple[int, float, str]] = []
    for name, status in gateways.items():
        slot = status.planner.slot if status.planner is not None else None
        if name != here and slot is not None and slot.state in ("ready", "swapping") and not status.draining:
            found.append((slot.queue, status.load, name))
    return [name for _, _, name in sorted(found)]


class PeerTier:
    """Plans by the local models of other gateways.

    Args:
        config: deadlines and tries.
        gateways: what the gateways that are there tell of themselves.
        ask: asks one of them.
        here: this gateway.
    """

    name = Tier.PEER
    repairs = False

    def __init__(
        self, config: LlmConfig, *, gateways: Callable[[], Mapping[str, GatewayStatus]], ask: Ask, here: str
    ) -> None:
        self._config = config
        self._gateways = gateways
        self._ask = ask
        self._here = here
        self._breakers: dict[str, Breaker] = {}

    @property
    def present(self) -> bool:
        """Whether any other gateway has a model."""
        return bool(candidates(self._gateways(), here=self._here))

    async def start(self) -> None:
        """Nothing is asked before the first instruction."""

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Ask gateways that have a model, one after the other.

        Raises:
            PlanError: the first that answered has no plan for it.
            UnreachableError: none answered; what each lacked is in the message.
        """
        del previous, problems
        if context.so_far is not None:
            raise PlanError("another gateway's model cannot continue a task that has begun")
        asked = ProposeAsk(instruction=context.instruction, robots=context.robots)
        lacked: list[str] = []
        for name in candidates(self._gateways(), here=self._here):
            if len(lacked) >= self._config.peer_tries:
                break
            breaker = self._breakers.setdefault(name, Breaker(failures=2, open_s=10.0, most_s=120.0))
            if not breaker.take(time.monotonic()):
                continue
            try:
                answer = await self._ask(name, asked, self._config.peer_deadline_s)
            except PlanError:
                breaker.succeeded()
                raise
            except (UnreachableError, DeadlineError) as error:
                breaker.failed(time.monotonic())
                lacked.append(f"{name}: {error.message}")
            except SwiftbotError as error:
                breaker.gave_up()
                lacked.append(f"{name}: {error.message}")
            except BaseException:
                breaker.gave_up()
                raise
            else:
                breaker.succeeded()
                return Proposal(
                    plan=answer.plan,
                    confidence=answer.confidence,
                    model=answer.model,
                    gateway=name,
                )
        raise UnreachableError(
            f"no other gateway's model answered: {'; '.join(lacked) or 'those that have one failed lately'}",
            remedy="see `swiftbot fleet` for who has a model",
        )

    async def close(self) -> None:
        """Nothing to release."""
