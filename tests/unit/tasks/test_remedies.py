"""No task ends as failed without a next step, whatever failed and wherever it failed."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import appliance
from appliance.errors import NotFoundError, PlanError, RefusedError, SwiftbotError
from appliance.model import Failure, RunEventKind, TaskState
from appliance.pool.runner.child import REASONS
from appliance.tasks.machine import TransitionKind
from appliance.tasks.record_writer import BY_CODE, Draft, remedied
from tests.unit.tasks.sample_records import accepted, plan_of

pytestmark = pytest.mark.anyio

ROOT = Path(appliance.__file__).parent
MAKERS = ("Failure", "RobotFailure", "CallError", "_error", "failed")
"""Calls that make a failure or an error frame; their code is the keyword `code` or the first argument."""


def calls(*names: str) -> Iterator[tuple[Path, ast.Call]]:
    """Return each call of these names in the product, with its file."""
    called = re.compile(rf"\b(?:{'|'.join(names)})\(")
    texts = {file: file.read_text(encoding="utf-8") for file in sorted(ROOT.rglob("*.py"))}
    for file, text in texts.items():
        for node in ast.walk(ast.parse(text)) if called.search(text) else ():
            if isinstance(node, ast.Call):
                name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                if name in names:
                    yield file, node


def literal_codes() -> set[str]:
    """Return every code of a failure that is written out in the product."""
    found: set[str] = set()
    for _, call in calls(*MAKERS):
        given_ = [each.value for each in call.keywords if each.arg == "code"] or call.args[:1]
        for each in given_:
            if isinstance(each, ast.Constant) and isinstance(each.value, str) and each.value:
                found.add(each.value)
    return found


def error_classes(root: type[SwiftbotError] = SwiftbotError) -> Iterator[type[SwiftbotError]]:
    """Return the error tree, as far as it can end a task: what only the command line raises cannot."""
    yield root
    for child in root.__subclasses__():
        if child.__module__.startswith(("appliance.cli", "appliance.tui")) or not child.__module__.startswith(
            "appliance"
        ):
            continue
        yield from error_classes(child)


def test_each_code_of_a_failure_has_a_remedy() -> None:
    """Of each error class, each failure that is written out in the product, and each way a run is ended."""
    codes = {each.code for each in error_classes()} | literal_codes() | set(REASONS.values())
    assert {"plan", "payload", "robot", "skill", "memory", "deadline", "orphaned"} <= codes, "the search finds them"
    assert sorted(codes - BY_CODE.keys()) == []
    assert all(text.strip() for text in BY_CODE.values())


def test_only_the_draft_makes_transitions_of_an_accepted_task() -> None:
    """It adds the remedies: a transition that another module makes would go past it."""
    made = {file.relative_to(ROOT).as_posix() for file, _ in calls("Transition")}
    assert made <= {"tasks/record_writer.py", "tasks/manager.py"}, (
        "the manager makes the first one, which holds no failure"
    )


FAILURES = st.builds(
    Failure,
    code=st.one_of(st.sampled_from(sorted(BY_CODE)), st.text(max_size=12)),
    message=st.text(max_size=20),
    remedy=st.sampled_from(["", " ", "wait a minute"]),
    retryable=st.booleans(),
)


@given(FAILURES)
def test_whatever_failed_the_record_says_what_to_do(failure: Failure) -> None:
    """A failure of planning, of an attempt or of the coordinator gets a remedy, whatever its code, or keeps its own."""
    unplanned = Draft(accepted(), "gw-1")
    unplanned.apply(TransitionKind.PLAN_FAILED, failure=failure)
    running = Draft(accepted(), "gw-1")
    running.apply(TransitionKind.PLANNED, plan=plan_of())
    running.apply(TransitionKind.ATTEMPT_FAILED, subtask="s1", attempt=1, failure=failure, give_up=True, replan=False)
    given_up = Draft(accepted(), "gw-1")
    given_up.apply(TransitionKind.PLANNED, plan=plan_of())
    given_up.apply(TransitionKind.CANCEL, failure=failure)
    for draft in (unplanned, running, given_up):
        ended = draft.record
        assert ended.state is TaskState.FAILED
        assert ended.failure is not None
        assert ended.failure.remedy.strip()
        assert "{task}" not in ended.failure.remedy
        if failure.remedy.strip():
            assert ended.failure.remedy == failure.remedy


def test_a_remedy_names_the_task_in_its_commands() -> None:
    """So that it can be copied into a terminal."""
    failure = remedied(Failure(code="unreachable", message="gw-2 was lost"), "t-7")
    assert "swiftbot task retry t-7" in failure.remedy


@pytest.mark.parametrize(
    "error",
    [PlanError("no plan"), RefusedError("full"), NotFoundError("no such skill"), RecursionError("too deep")],
    ids=lambda error: type(error).__name__,
)
async def test_a_plan_that_fails_has_a_remedy(bench: Any, error: Exception) -> None:
    """Whatever the planner raises, also an error without a remedy."""
    bench.context.the_plan = error
    await bench.start()
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert ended.failure.remedy


async def test_a_run_that_fails_has_a_remedy(bench: Any) -> None:
    """Also in the stored record, where other gateways and the command line read it."""
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.FAILED, failure=Failure(code="made-up", message="slipped"))
    assert (await bench.end()).state is TaskState.FAILED
    assert bench.stored().failure.remedy


async def test_a_task_that_cannot_be_driven_has_a_remedy(bench: Any) -> None:
    """Its drivers broke again and again: it is ended with the reason and the next step."""
    await bench.start(give_up=Failure(code="internal", message="driving it broke"))
    assert (await bench.end()).failure.remedy
