"""Handing a run over: whatever those that are asked answer, the run is in one place, and what was done is undone."""

from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import DeadlineError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import Need, Phase, RunAccepted, RunRequest
from appliance.model.task_api import Held, Reserved, RunAsk, RunStatus
from appliance.tasks.handoff import Handoff, Outcome, run_of

pytestmark = pytest.mark.anyio

REQUEST = RunRequest(task="t-1", subtask="s1", attempt=2, skill="work", need=Need(image="base"))
BEFORE = RunAsk(task="t-1", subtask="s1", attempt=1)


class Fleet:
    """Gateways that answer as the test says; the order of what they were asked."""

    def __init__(self, **problems: SwiftbotError | None) -> None:
        self.problems = problems
        self.asked: list[tuple[str, str]] = []
        self.refused: list[str] = []
        self.rpc = self
        self.session = self

    async def call(self, gateway: str, verb: Any, ask: Any, *, timeout_s: float) -> Any:
        """Answer."""
        assert timeout_s > 0
        self.asked.append((verb.name, gateway))
        if (problem := self.problems.get(gateway)) is not None:
            raise problem
        match verb.name:
            case "run":
                return RunAccepted(gateway=gateway, container="c1", phase=Phase.LOCAL_WARM)
            case "run_reserve":
                return Reserved(gateway=gateway, container="c1", phase=Phase.LOCAL_WARM, lease_s=15.0)
            case "run_hold":
                return Held(began=True, fresh=True, saved=True, hold_s=10.0)
            case _:
                assert isinstance(ask, RunAsk)
                return RunStatus(running=False)

    def refuse(self, what: str, **_: object) -> None:
        """Count."""
        self.refused.append(what)


class Candidates:
    """Gateways in a fixed order."""

    def __init__(self, *gateways: str) -> None:
        self.left = list(gateways)
        self.outcomes: list[bool | None] = []

    async def best(self) -> str:
        """Return the next."""
        return self.left.pop(0) if self.left else ""

    def note(self, outcome: Outcome) -> None:
        """Keep it."""
        self.outcomes.append(outcome.taken)


SILENT = UnreachableError("gone while it was asked", sent=True)
PROBLEMS: tuple[SwiftbotError | None, ...] = (
    None, RefusedError("full"), UnreachableError("not there"), SILENT, DeadlineError("no answer")
)  # fmt: skip


@given(st.lists(st.sampled_from(PROBLEMS), max_size=5))
async def test_a_run_that_has_not_begun_is_ordered_until_one_takes_it_or_may_have_it(
    answers: list[SwiftbotError | None],
) -> None:
    """In the order of the offers; after an order that may have arrived nobody else is asked: it would run twice."""
    problems = {f"gw{number}": problem for number, problem in enumerate(answers)}
    fleet, offers = Fleet(**problems), Candidates(*problems)
    ends = [i for i, each in enumerate(answers) if each in (None, SILENT, PROBLEMS[-1])]
    asked = answers[: ends[0] + 1] if ends else answers
    handoff = Handoff(cast("Any", fleet), REQUEST)
    if ends and answers[ends[0]] is not None:
        with pytest.raises(UnreachableError, match="did not say whether"):
            await handoff.begin(offers)
    else:
        accepted = await handoff.begin(offers)
        assert (accepted is None) == (not ends)
    assert fleet.asked == [("run", f"gw{number}") for number in range(len(asked))]
    assert offers.outcomes == [
        True if each is None else None if each in (SILENT, PROBLEMS[-1]) else False for each in asked
    ]
    assert fleet.refused == ["stale offer"] * offers.outcomes.count(False)


async def test_a_container_is_looked_for_further_when_one_gateway_says_nothing() -> None:
    """Nothing runs by a reservation, which ends by itself."""
    fleet, offers = Fleet(gw1=DeadlineError("no answer")), Candidates("gw1", "gw2")
    async with Handoff(cast("Any", fleet), REQUEST) as handoff:
        reserved = await handoff.reserve(offers)
        handoff.commit()
    assert reserved is not None
    assert (reserved.gateway, offers.outcomes) == ("gw2", [False, True])


@pytest.mark.parametrize("committed", [True, False])
async def test_what_is_not_committed_is_undone_the_last_first(committed: bool) -> None:
    """The run goes on where it was, then its container elsewhere is let go of; after the commit neither."""
    fleet = Fleet()
    async with Handoff(cast("Any", fleet), REQUEST) as handoff:
        assert await handoff.reserve(Candidates("gw2")) is not None
        await handoff.hold("gw1", BEFORE)
        if committed:
            handoff.commit()
    undone = [] if committed else [("run_resume", "gw1"), ("run_unreserve", "gw2")]
    assert fleet.asked == [("run_reserve", "gw2"), ("run_hold", "gw1"), *undone]


async def test_a_hold_without_an_answer_is_undone_as_well() -> None:
    """The run may be held all the same; that undoing it fails too hides nothing of what went wrong."""
    fleet = Fleet(gw1=DeadlineError("no answer"))
    with pytest.raises(DeadlineError):
        async with Handoff(cast("Any", fleet), REQUEST) as handoff:
            await handoff.hold("gw1", BEFORE)
    assert fleet.asked == [("run_hold", "gw1"), ("run_resume", "gw1")]
    assert run_of(REQUEST).run_id == REQUEST.run_id
