"""Gets the plan of a task that is being driven, unless a cancel comes first."""

import asyncio
import math
import time

import structlog

from appliance.errors import PlanError, SwiftbotError
from appliance.model import Failure, Plan
from appliance.tasks.bounds import clean
from appliance.tasks.deadline import left_s, passed
from appliance.tasks.keeper import Keeper
from appliance.tasks.machine import TransitionKind
from appliance.tasks.surroundings import CancelAsked, Input, Surroundings

log = structlog.get_logger(__name__)


async def plan_it(around: Surroundings, keeper: Keeper, inbox: "asyncio.Queue[Input]") -> None:
    """Plan the task; whatever comes of it is a transition. News that come meanwhile are of no use and dropped."""
    planning = asyncio.ensure_future(around.plan(keeper.record))
    try:
        record = keeper.record
        if await _cancelled_before(planning, inbox, time.monotonic() + left_s(record, keeper.elapsed_s)):
            keeper.apply(keeper.transition(TransitionKind.CANCEL))
            return
        if not planning.done():
            keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=passed(record)))
            return
        plan = planning.result()
        note = around.expect(plan, deadline_s=record.deadline_s, elapsed_s=keeper.elapsed_s)
        keeper.apply(keeper.transition(TransitionKind.PLANNED, plan=plan, note=note))
    except SwiftbotError as error:
        keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=_plan_failure(error)))
    except Exception as error:  # the boundary to the planner: whatever breaks in it, the submitter is told
        log.exception("planning broke", task=keeper.record.id)
        failure = Failure(code="internal", message=clean(f"planning broke: {type(error).__name__}: {error}", 500))
        keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=failure))
    finally:
        planning.cancel()


async def _cancelled_before(planning: "asyncio.Future[Plan]", inbox: "asyncio.Queue[Input]", deadline: float) -> bool:
    """Wait for the plan, until the deadline at most; True if a cancel came first."""
    while not planning.done() and (left := deadline - time.monotonic()) > 0:
        asking = asyncio.ensure_future(inbox.get())
        try:
            await asyncio.wait(
                {planning, asking},
                return_when=asyncio.FIRST_COMPLETED,
                timeout=None if math.isinf(left) else left,
            )
            if asking.done() and isinstance(asking.result(), CancelAsked):
                return True
        finally:
            asking.cancel()
    return False


def _plan_failure(error: SwiftbotError) -> Failure:
    problems = error.problems if isinstance(error, PlanError) else ()
    message = error.message if not problems else f"{error.message}: {'; '.join(problems[:5])}"
    return Failure(code=error.code, message=message, remedy=error.remedy)
