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
from appliance.tasks.surroundings import CancelAsked, Input, Steered, Surroundings

log = structlog.get_logger(__name__)


async def plan_it(around: Surroundings, keeper: Keeper, inbox: "asyncio.Queue[Input]") -> None:
    """Plan the task; whatever comes of it is a transition.

    Operators' orders that come meanwhile are looked at afterwards; other news are of no use and dropped.
    """
    planning = asyncio.ensure_future(around.plan(keeper.record))
    later: list[Input] = []
    try:
        record = keeper.record
        until = time.monotonic() + left_s(record, keeper.elapsed_s)
        if (cancel := await _cancelled_before(planning, inbox, until, later)) is not None:
            keeper.apply(keeper.transition(TransitionKind.CANCEL, word=cancel.word))
            return
        if not planning.done():
            keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=passed(record)))
            return
        plan = planning.result()
        note = around.expect(plan, deadline_s=record.deadline_s, elapsed_s=keeper.elapsed_s)
        if why := around.approval(record, plan):
            waits = keeper.transition(
                TransitionKind.PROPOSED, plan=plan, note=clean(why, 500), waits=True,
                expires_s=around.config.approval_s,
            )  # fmt: skip
            keeper.apply(waits)
            return
        keeper.apply(keeper.transition(TransitionKind.PLANNED, plan=plan, note=note))
    except SwiftbotError as error:
        keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=_plan_failure(error)))
    except Exception as error:  # the boundary to the planner: whatever breaks in it, the submitter is told
        log.exception("planning broke", task=keeper.record.id)
        failure = Failure(code="internal", message=clean(f"planning broke: {type(error).__name__}: {error}", 500))
        keeper.apply(keeper.transition(TransitionKind.PLAN_FAILED, failure=failure))
    finally:
        planning.cancel()
        for news in later:
            inbox.put_nowait(news)


async def _cancelled_before(
    planning: "asyncio.Future[Plan]", inbox: "asyncio.Queue[Input]", deadline: float, later: list[Input]
) -> CancelAsked | None:
    """Wait for the plan, until the deadline at most; a cancel that came first. `later` gets operators' other orders."""
    while not planning.done() and (left := deadline - time.monotonic()) > 0:
        asking = asyncio.ensure_future(inbox.get())
        try:
            await asyncio.wait(
                {planning, asking},
                return_when=asyncio.FIRST_COMPLETED,
                timeout=None if math.isinf(left) else left,
            )
            if asking.done():
                news = asking.result()
                if isinstance(news, CancelAsked):
                    return news
                if isinstance(news, Steered):
                    later.append(news)
        finally:
            asking.cancel()
    return None


def _plan_failure(error: SwiftbotError) -> Failure:
    problems = error.problems if isinstance(error, PlanError) else ()
    message = error.message if not problems else f"{error.message}: {'; '.join(problems[:5])}"
    return Failure(code=error.code, message=message, remedy=error.remedy)
