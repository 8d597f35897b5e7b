"""Which of a model's answers the local tier takes; the model itself is real in tests/integration."""

from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import DeadlineError, PlanError
from appliance.llm.local import LocalTier
from appliance.llm.review import Facts, review
from appliance.llm.settings import LlmConfig, PlanContext, SafetyConfig
from appliance.llm.tier import Proposal
from appliance.model import RobotInfo
from appliance.skills.catalogue import load_catalogue

pytestmark = pytest.mark.anyio

CATALOGUE = load_catalogue()
GOTO = CATALOGUE.skills["goto"]
ROVER = RobotInfo(id="rover_1", kind="zenoh", uses=tuple(GOTO.uses), verbs=tuple(GOTO.verbs))
CONTEXT = PlanContext(instruction="rover_1 goes to dock 3", robots=(ROVER,))
RIGHT = ["navigation", "goto", "w0", "w0", "place:", "w3", "w4"]
NOWHERE = ["navigation", "goto", "w0", "w0"]
UNREADABLE = ["navigation", "goto", "w99", "w99", "place:", "w3", "w4"]
HOME = ["return_home", "w0", "w0"]
REFUSED = ["none", "chatter"]


Answers = list[tuple[list[str], float]]


class Model:
    """A model's process that answers what it was made with, likeliest first; what it is asked is kept."""

    folder = "/models/fake"
    speaks = True

    def __init__(self, answers: Answers, thorough: Answers | Exception | None = None) -> None:
        self._answers = {False: answers, True: thorough or answers}
        self.asked: list[bool] = []

    async def ready(self) -> None:
        """It is."""

    async def exchange(self, order: dict[str, Any]) -> dict[str, Any]:
        """Answer."""
        self.asked.append(order["question"]["thorough"])
        answers = self._answers[self.asked[-1]]
        if isinstance(answers, Exception):
            raise answers
        (symbols, confidence), *others = answers
        return {
            "symbols": symbols,
            "confidence": confidence,
            "others": [{"symbols": each, "confidence": sure} for each, sure in others],
            "tokens": 30,
            "ms": 5.0,
        }


async def proposed(model: Model, context: PlanContext = CONTEXT) -> Proposal:
    """Return what the tier proposes."""
    tier = LocalTier(LlmConfig(local_model=Model.folder), CATALOGUE)
    tier._process = model  # pyright: ignore[reportAttributeAccessIssue]
    return await tier.propose(context)


def held(proposal: Proposal, context: PlanContext) -> tuple[str, ...]:
    """Return why the review holds a proposal."""
    return review(Facts(proposal.plan, context, CATALOGUE, SafetyConfig())).holds


async def asked(*answers: tuple[list[str], float]) -> tuple[dict[str, object], float]:
    """Return parameters and confidence of what the tier proposes."""
    proposal = await proposed(Model(list(answers)))
    return proposal.plan.subtasks[0].params, proposal.confidence


async def test_the_likeliest_answer_that_breaks_no_rule_is_taken() -> None:
    """With its own confidence: an unlikely plan does not borrow that of the one it replaces."""
    assert await asked((RIGHT, 0.9), (NOWHERE, 0.05)) == ({"place": "dock 3"}, 0.9)
    assert await asked((NOWHERE, 0.8), (UNREADABLE, 0.1), (REFUSED, 0.05), (RIGHT, 0.04)) == ({"place": "dock 3"}, 0.04)


async def test_when_all_break_a_rule_the_likeliest_is_told() -> None:
    """Its problems are what repair and refusal go by; the review refuses or holds it, whatever the model says."""
    assert await asked((NOWHERE, 0.8), (UNREADABLE, 0.1), (NOWHERE, 0.05)) == ({}, pytest.approx(0.8))


async def test_when_all_break_a_rule_others_are_looked_for_once() -> None:
    """The first answers are enough where one breaks no rule; where none does, one that is found later is taken."""
    model = Model([(NOWHERE, 0.8), (RIGHT, 0.1)])
    await proposed(model)
    assert model.asked == [False]
    model = Model([(NOWHERE, 0.8)], thorough=[(NOWHERE, 0.8), (UNREADABLE, 0.1), (RIGHT, 0.02)])
    proposal = await proposed(model)
    assert (proposal.plan.subtasks[0].params, proposal.confidence) == ({"place": "dock 3"}, 0.02)
    assert model.asked == [False, True]


async def test_of_a_doubtful_plan_others_are_looked_for_and_why_is_told() -> None:
    """One without doubts is taken unless it is far less likely; a doubtful one is held, with the reason."""
    two = PlanContext(
        instruction="rover_1 goes to dock 3 while rover_2 does", robots=(ROVER, replace(ROVER, id="rover_2"))
    )
    both = [*RIGHT, "|", "goto", "w6", "w6", *RIGHT[4:]]
    proposal = await proposed(Model([(RIGHT, 0.8), (both, 0.1)]), two)
    assert [each.robot for each in proposal.plan.subtasks] == ["rover_1", "rover_2"]
    for least in (0.03, 0.0):
        model = Model([(RIGHT, 0.8), (both, least)] if least else [(RIGHT, 0.8)])
        proposal = await proposed(model, two)
        assert model.asked == [False, True]
        assert [each.robot for each in proposal.plan.subtasks] == ["rover_1"]
        assert "rover_2 is named and has nothing to do" in held(proposal, two)


async def test_of_plans_that_robots_cannot_do_the_one_that_is_meant_is_told() -> None:
    """The validator refuses both; the likelier one cannot be meant, and the refusal should be of what was asked for."""
    here = replace(CONTEXT, robots=(RobotInfo(id="rover_1", kind="zenoh"),))
    there_twice = [*RIGHT, "|", *RIGHT[1:], "<", "1"]
    proposal = await proposed(Model([(there_twice, 0.6), (RIGHT, 0.3)]), here)
    assert [each.params for each in proposal.plan.subtasks] == [{"place": "dock 3"}]


async def test_the_plan_there_is_outlives_a_second_look_that_fails() -> None:
    """Late, a refusal, no plan at all: the likeliest of the first answers is what is reported."""
    for thorough in ([(REFUSED, 0.9)], [(UNREADABLE, 0.9)], DeadlineError("no answer within 1 s")):
        model = Model([(NOWHERE, 0.8)], thorough=thorough)
        assert (await proposed(model)).plan.subtasks[0].params == {}
        assert model.asked == [False, True]


@pytest.mark.parametrize(
    "senseless",
    [
        pytest.param([*RIGHT, "|", *RIGHT[1:], "<", "1"], id="a way to where it already is"),
        pytest.param([*RIGHT, "|", "goto", "w0", "w0", "place:", "w4", "w4"], id="two ways at once"),
        pytest.param(
            ["navigation", "return_home", "w0", "w0", "|", "return_home", "w0", "w0", "<", "1"], id="home twice"
        ),
        pytest.param(["manipulation", *RIGHT[1:]], id="a domain of none of its skills"),
    ],
)
async def test_what_cannot_be_meant_is_not_taken(senseless: list[str]) -> None:
    """A valid plan that breaks a rule by which instructions are read gives way to the next likely one."""
    proposal = await proposed(Model([(senseless, 0.6), (RIGHT, 0.3)]))
    assert proposal.plan.domain == "navigation"
    assert [each.params for each in proposal.plan.subtasks] == [{"place": "dock 3"}]


async def test_a_refusal_is_no_plan() -> None:
    """Whatever else the model might have said, it found no order in the words."""
    with pytest.raises(PlanError, match="holds no order"):
        await asked((REFUSED, 0.9), (RIGHT, 0.1))


class Wordings(Model):
    """A model that answers each wording of an order in its own way; what it is asked is kept, words and roster."""

    def __init__(self, answers: dict[str, tuple[list[str], float]]) -> None:
        super().__init__([])
        self._by_text = answers
        self.heard: list[tuple[str, tuple[str, ...]]] = []

    async def exchange(self, order: dict[str, Any]) -> dict[str, Any]:
        """Answer."""
        question = order["question"]
        self.heard.append((question["text"], tuple(question["robots"])))
        symbols, confidence = self._by_text[question["text"]]
        return {"symbols": symbols, "confidence": confidence, "others": [], "tokens": 30, "ms": 5.0}


ROVERS = tuple(replace(ROVER, id=f"rover_{number}") for number in range(1, 41))
EVERYBODY = PlanContext(instruction="all rovers go to dock 3", robots=ROVERS)
NAMED, TYPED = "rover_1 and rover_2 go to dock 3", "all rovers go to dock 3"
BOTH_NAMED = [
    "navigation",
    *("goto", "w0", "w0", "place:", "w5", "w6"),
    "|",
    *("goto", "w2", "w2", "place:", "w5", "w6"),
]
BOTH_TYPED = [
    "navigation",
    *("goto", "w6", "w6", "place:", "w4", "w5"),
    "|",
    *("goto", "w7", "w7", "place:", "w4", "w5"),
]
IN_TURN = [*BOTH_TYPED, "<", "1"]


async def test_what_two_of_a_group_do_is_given_to_all_of_it() -> None:
    """Of forty rovers the model sees two, whichever way the order is worded; the plan is for forty."""
    model = Wordings({NAMED: (BOTH_NAMED, 0.8), TYPED: (BOTH_TYPED, 0.6)})
    proposal = await proposed(model, EVERYBODY)
    assert {text for text, _ in model.heard} == {NAMED, TYPED}
    assert {robots for _, robots in model.heard} == {("rover_1", "rover_2")}
    assert [each.robot for each in proposal.plan.subtasks] == [each.id for each in ROVERS]
    assert proposal.confidence == pytest.approx(0.8)
    assert held(proposal, EVERYBODY) == ()


@pytest.mark.parametrize(("named", "robots"), [(0.8, 2), (0.97, 40)])
async def test_of_two_wordings_the_typed_one_counts_unless_the_other_is_far_surer(named: float, robots: int) -> None:
    """A model errs in one where it is right in the other; what was said is what it was taught."""
    model = Wordings({NAMED: (BOTH_NAMED, named), TYPED: (IN_TURN, 0.3)})
    proposal = await proposed(model, EVERYBODY)
    assert len(proposal.plan.subtasks) == robots
    # One after the other is no plan for forty: it stays one for two, and a person sees it.
    assert bool(held(proposal, EVERYBODY)) == (robots == 2)


async def test_one_wording_is_enough() -> None:
    """Where the model has no plan for one of them, the other's is taken; where for none, the reason is given."""
    model = Wordings({NAMED: (REFUSED, 0.9), TYPED: (BOTH_TYPED, 0.6)})
    assert len((await proposed(model, EVERYBODY)).plan.subtasks) == len(ROVERS)
    with pytest.raises(PlanError, match="holds no order"):
        await proposed(Wordings({NAMED: (REFUSED, 0.9), TYPED: (REFUSED, 0.9)}), EVERYBODY)
