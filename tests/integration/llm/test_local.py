"""The local slot with a real model: a tiny one, built here, in a real process of its own."""

import asyncio
import contextlib
import importlib.util
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from appliance.errors import DeadlineError, PlanError, PrerequisiteError, SwiftbotError, UnreachableError
from appliance.llm.cascade import Decomposer
from appliance.llm.checks.schema import validate
from appliance.llm.local import LocalTier
from appliance.llm.prompt import GRAMMAR_SUBTASKS
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.model import RobotInfo, Tier
from appliance.skills.catalogue import load_catalogue

pytestmark = pytest.mark.anyio

CATALOGUE = load_catalogue()
ROBOTS = (RobotInfo(id="rover_1", kind="zenoh"), RobotInfo(id="drone_1", kind="mavlink", flies=True))
TOKENS = 32_768
"""The tiny model's tokens are bytes, so its prompts are long."""


def _builder(root: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("tiny_model", root / "tests" / "tiny_model.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Callable[..., Path]:
    """Return a function that builds a tiny model folder."""
    module = _builder(project_root)

    def build(**options: Any) -> Path:
        return module.build(tmp_path_factory.mktemp("model"), **options)

    return build


@pytest.fixture(scope="session")
def model(tiny: Callable[..., Path]) -> Path:
    """Return a tiny model that prefers short plans."""
    return tiny()


@asynccontextmanager
async def running(folder: Path, **more: Any) -> AsyncIterator[LocalTier]:
    """Run a local tier on a folder."""
    tier = LocalTier(LlmConfig(local_model=str(folder), local_max_tokens=TOKENS, **more), CATALOGUE)
    with contextlib.suppress(PrerequisiteError):
        await tier.start()
    try:
        yield tier
    finally:
        await tier.close()


def about(text: str, *, roster: bool = True) -> PlanContext:
    """Return the context of an instruction."""
    return PlanContext(instruction=text, robots=ROBOTS if roster else None)


async def test_random_weights_give_valid_plans(model: Path) -> None:
    """Under the grammar even a model that knows nothing writes plans of the right form, with or without a roster."""
    async with running(model) as tier:
        for text in ("Rover_1: go to dock 1", "All robots film the yard, then report"):
            for roster in (True, False):
                proposal = await tier.propose(about(text, roster=roster))
                assert proposal.plan.tier is Tier.LOCAL
                assert validate(proposal.plan, CATALOGUE) == ()
                assert 0 <= proposal.confidence <= 1
        again = await tier.propose(about("Rover_1: go to dock 1", roster=False))
        assert again == await tier.propose(about("Rover_1: go to dock 1", roster=False))


async def test_long_plans_stay_valid_and_bounded(tiny: Callable[..., Path]) -> None:
    """A model that does not come to an end is held by the grammar: its longest plan, no circle, no unknown skill."""
    async with running(tiny(like=',"'), local_deadline_s=60.0) as tier:
        proposal = await tier.propose(about("Rover_1: go to dock 1"))
        assert validate(proposal.plan, CATALOGUE) == ()
        assert len(proposal.plan.subtasks) == GRAMMAR_SUBTASKS
        assert any(each.after for each in proposal.plan.subtasks)


async def test_repair_is_asked_of_the_same_process(model: Path) -> None:
    """A repair prompt goes to the process that is loaded, and gives a plan again."""
    async with running(model) as tier:
        first = await tier.propose(about("go"))
        pid = tier.pid
        assert (await tier.propose(about("go"), previous=first.plan, problems=("s1: no",))).plan.subtasks
        assert tier.pid == pid


async def test_killed_process_is_named_and_restarted(model: Path) -> None:
    """SIGKILL in mid-answer gives the waiting instruction a clear error, and the next one a new process."""
    async with running(model) as tier:
        await tier.propose(about("go"))
        pid = tier.pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        waiting = asyncio.create_task(tier.propose(about("go")))
        await asyncio.sleep(0.05)
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(UnreachableError, match="ended by signal 9"):
            await waiting
        while tier.pid is None:
            await asyncio.sleep(0.02)
        assert tier.pid != pid
        assert tier.restarts == 1
        assert (await tier.propose(about("go"))).plan.subtasks


async def test_answer_that_was_given_up_is_not_mixed_up(model: Path) -> None:
    """An instruction that is cancelled leaves no answer for the next one."""
    async with running(model) as tier:
        await tier.propose(about("go"))
        for _ in range(3):
            given_up = asyncio.create_task(tier.propose(about("Rover_1: go to dock 1")))
            await asyncio.sleep(0.01)
            given_up.cancel()
            with pytest.raises(asyncio.CancelledError):
                await given_up
        both = await asyncio.gather(tier.propose(about("a")), tier.propose(about("b")))
        assert all(validate(each.plan, CATALOGUE) == () for each in both)


async def test_slow_model_ends_at_its_deadline(tiny: Callable[..., Path]) -> None:
    """Generation stops at the deadline inside the process, which then serves the next instruction."""
    async with running(tiny(like=',"'), local_deadline_s=0.2) as tier:
        with pytest.raises(DeadlineError, match="did not end in time"):
            await tier.propose(about("go"))
        pid = tier.pid
        with pytest.raises(DeadlineError):
            await tier.propose(about("go"))
        assert tier.pid == pid


async def test_prompt_that_is_too_long_is_refused(model: Path) -> None:
    """A prompt beyond the model's context is a PlanError with a remedy, and the process lives on."""
    tier = LocalTier(LlmConfig(local_model=str(model), local_max_tokens=1024), CATALOGUE)
    await tier.start()
    try:
        with pytest.raises(PlanError, match="may use 1024") as caught:
            await tier.propose(about("go"))
        assert "local_max_tokens" in caught.value.remedy
    finally:
        await tier.close()


def _empty(folder: Path, model: Path) -> None:
    folder.mkdir()


def _absent(folder: Path, model: Path) -> None:
    pass


def _no_json(folder: Path, model: Path) -> None:
    folder.mkdir()
    (folder / "genai_config.json").write_text("{")


def _cut_model(folder: Path, model: Path) -> None:
    folder.mkdir()
    for file in model.iterdir():
        data = file.read_bytes()
        (folder / file.name).write_bytes(data[: len(data) // 2] if file.suffix == ".onnx" else data)


def _no_tokenizer(folder: Path, model: Path) -> None:
    folder.mkdir()
    for file in model.iterdir():
        if not file.name.startswith("tokenizer"):
            (folder / file.name).write_bytes(file.read_bytes())


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_absent, "no model folder"),
        (_empty, "no genai_config.json"),
        (_no_json, "damaged"),
        (_cut_model, "cannot be loaded"),
        (_no_tokenizer, "cannot be loaded"),
    ],
)
async def test_bad_folder_is_a_clear_error(
    spoil: Callable[[Path, Path], None], said: str, model: Path, tmp_path: Path
) -> None:
    """An absent, empty or damaged model folder is a PrerequisiteError that names it and what to do."""
    folder = tmp_path / "model"
    spoil(folder, model)
    async with running(folder) as tier:
        with pytest.raises(PrerequisiteError, match=said) as caught:
            await tier.propose(about("go"))
        assert str(folder) in str(caught.value)
        assert caught.value.remedy


async def test_folder_that_is_mended_is_loaded(model: Path, tmp_path: Path) -> None:
    """A model that is put in its place later is found without a restart of the gateway."""
    folder = tmp_path / "model"
    async with running(folder) as tier:
        with pytest.raises(PrerequisiteError):
            await tier.propose(about("go"))
        model_copy = [(file.name, file.read_bytes()) for file in model.iterdir()]
        folder.mkdir()
        for name, data in sorted(model_copy, reverse=True):
            (folder / name).write_bytes(data)
        while tier.pid is None:
            await asyncio.sleep(0.05)
        assert (await tier.propose(about("go"))).plan.subtasks


async def test_process_ends_with_its_tier(model: Path) -> None:
    """Closing the tier leaves no process behind."""
    async with running(model) as tier:
        await tier.propose(about("go"))
        pid = tier.pid
    assert pid is not None
    assert not Path(f"/proc/{pid}").exists()


async def test_slot_ends_when_its_gateway_is_gone(model: Path) -> None:
    """The process ends by itself when its input ends, as when a gateway is killed."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.llm.worker", str(model),
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(each for each in sys.path if each)},
    )  # fmt: skip
    assert process.stdin is not None
    process.stdin.close()
    async with asyncio.timeout(30):
        assert await process.wait() == 0


async def test_cascade_falls_back_from_a_model_that_guesses(model: Path) -> None:
    """A model that is not sure is passed over for the rules, and so is a folder that is not there."""
    for folder in (str(model), "/nonexistent/model"):
        cascade = Decomposer(LlmConfig(local_model=folder, local_max_tokens=TOKENS, run_confidence=0.6), CATALOGUE)
        await cascade.start()
        try:
            outcome = await cascade.plan(PlanContext(instruction="Rover_1: go to dock 1"))
        except SwiftbotError as error:
            pytest.fail(str(error))
        finally:
            await cascade.close()
        assert outcome.plan.tier is Tier.RULES
        assert [attempt.tier for attempt in outcome.attempts] == ["local", "rules"]
        assert not outcome.attempts[0].ok
