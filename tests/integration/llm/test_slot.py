"""The slot under load and change: a bounded queue, answers that are broken off, another model that takes over."""

import asyncio
import contextlib
import importlib.util
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import DeadlineError, PlanError, PrerequisiteError, RefusedError, SwiftbotError
from appliance.llm.cascade import Decomposer
from appliance.llm.local import LocalTier
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.model import RobotInfo, Site
from appliance.skills.catalogue import load_catalogue

pytestmark = pytest.mark.anyio

CATALOGUE = load_catalogue()
ROBOTS = (RobotInfo(id="rover_1", kind="zenoh"), RobotInfo(id="drone_1", kind="mavlink", flies=True))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Callable[..., Path]:
    """Return a function that builds a tiny model folder of that name."""
    spec = importlib.util.spec_from_file_location("tiny_model", project_root / "tests" / "tiny_model.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made: dict[str, Path] = {}

    def build(name: str, **options: Any) -> Path:
        if name not in made:
            made[name] = module.build(tmp_path_factory.mktemp(name) / name, **options)
        return made[name]

    return build


def config(folder: Path, **more: Any) -> LlmConfig:
    """Return a configuration with a local tier alone."""
    given = {"tiers": ("local",), "local_max_tokens": 32_768, "local_deadline_s": 120.0, **more}
    return LlmConfig(local_model=str(folder), **given)


@pytest.fixture
async def slow(tiny: Callable[..., Path]) -> AsyncIterator[LocalTier]:
    """A tier whose model does not come to an end soon: every answer is as long as the grammar allows."""
    tier = LocalTier(config(tiny("wordy", like=',"'), local_queue=3), CATALOGUE)
    await tier.start()
    yield tier
    await tier.close()


def about(text: str) -> PlanContext:
    """Return the context of an instruction."""
    return PlanContext(instruction=text, robots=ROBOTS)


async def test_the_queue_is_bounded_and_says_when_to_ask_again(slow: LocalTier) -> None:
    """Three may be inside; the fourth is refused at once with a time, and counted; the others are not touched."""
    asking = [asyncio.create_task(slow.propose(about(f"Rover_1: go to dock {number}"))) for number in range(3)]
    await asyncio.sleep(0)
    assert slow.status.queue == 3
    with pytest.raises(RefusedError, match="wait for the local model") as caught:
        await slow.propose(about("one more"))
    assert caught.value.retry_after_s > 0
    assert slow.status.refused == 1
    for each in asking:
        each.cancel()
    await asyncio.gather(*asking, return_exceptions=True)
    assert slow.status.queue == 0


async def test_what_nobody_waits_for_is_broken_off(slow: LocalTier) -> None:
    """An answer that would take long is broken off in the process when it is given up: the next one has its turn."""
    await slow.propose(about("warm up"))
    longest = slow.status.answered
    for number in range(5):
        asking = asyncio.create_task(slow.propose(about(f"Rover_1: go to dock {number}")))
        while not slow._process._waiting:
            await asyncio.sleep(0)
        asking.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asking
    assert (await slow.propose(about("Rover_1: hold"))).plan.subtasks
    status = slow.status
    assert status.answered == longest + 1
    assert status.cancelled == 5
    assert status.restarts == 0


async def test_figures_of_the_process(tiny: Callable[..., Path]) -> None:
    """Tokens a second, memory, threads and reuse are reported; the second prompt reuses what the first has computed."""
    tier = LocalTier(config(tiny("terse"), local_threads=1), CATALOGUE)
    await tier.start()
    try:
        await tier.propose(about("Rover_1: go to the yard"))
        assert tier.status.reused_tokens == 0
        await tier.propose(about("Rover_1: go to the gate"))
        status = tier.status
        assert status.state == "ready"
        assert status.model == "terse"
        assert status.answered == 2
        assert status.tokens_s > 0
        assert status.memory_mb > 10
        assert status.threads == 1
        assert status.reused_tokens > 1000
    finally:
        await tier.close()
    assert tier.status.state in ("loading", "down")


async def test_places_of_the_site_do_not_cost_the_warm_prefix(tiny: Callable[..., Path]) -> None:
    """A place that looks like a robot's name changes the grammar only where no site knows it."""
    from appliance.llm.prompt import robot_names  # noqa: PLC0415 - what is tested
    from appliance.model import Place  # noqa: PLC0415

    site = Site(places={"dock 1": Place(x=1, y=1), "dock 2": Place(x=2, y=2)})
    names = {robot_names(ROBOTS, f"rover_1: go to dock {number}", site) for number in (1, 2)}
    assert len(names) == 1
    assert robot_names(ROBOTS, "rover_1: go to dock 1") != robot_names(ROBOTS, "rover_1: go to dock 2")


async def test_another_model_takes_over_without_a_gap(tiny: Callable[..., Path]) -> None:
    """While the new one loads and is tested the old one answers; then a new process does, and the old one is gone."""
    tier = LocalTier(config(tiny("terse")), CATALOGUE)
    await tier.start()
    try:
        await tier.propose(about("Rover_1: go to dock 1"))
        before = tier.pid
        swapping = asyncio.create_task(tier.swap(str(tiny("other", seed=11))))
        answers = 0
        while not swapping.done():
            answers += bool((await tier.propose(about("Rover_1: hold"))).plan.subtasks)
        assert len(await swapping) == 3
        assert answers
        assert tier.model == "other"
        assert tier.pid not in (None, before)
        assert before is not None
        assert not Path(f"/proc/{before}").exists()
        assert (await tier.propose(about("Rover_1: hold"))).model == "other"
    finally:
        await tier.close()


def _absent(good: Path, folder: Path) -> None:
    pass


def _cut(good: Path, folder: Path) -> None:
    folder.mkdir()
    for file in good.iterdir():
        data = file.read_bytes()
        (folder / file.name).write_bytes(data[: len(data) // 2] if file.suffix == ".onnx" else data)


def _mute(good: Path, folder: Path) -> None:
    """A model of the plan language that knows no skill: whatever it says is no plan."""
    import json  # noqa: PLC0415

    folder.mkdir()
    for file in good.iterdir():
        data = file.read_bytes()
        if file.name == "planner.json":
            card = json.loads(data)
            skills = set(CATALOGUE.skills)
            card["tokens"] = {symbol: token for symbol, token in card["tokens"].items() if symbol not in skills}
            data = json.dumps(card).encode()
        (folder / file.name).write_bytes(data)


@pytest.mark.parametrize(
    ("spoil", "error", "said"),
    [
        (_absent, PrerequisiteError, "no model folder"),
        (_cut, PrerequisiteError, "cannot be loaded"),
        (_mute, PlanError, "fails its self-test"),
    ],
)
async def test_a_model_that_is_no_good_changes_nothing(
    spoil: Callable[[Path, Path], None],
    error: type[SwiftbotError],
    said: str,
    tiny: Callable[..., Path],
    tmp_path: Path,
) -> None:
    """Absent, damaged, or without a valid plan to any plain order: the reason is reported, and the old one goes on."""
    folder = tmp_path / "new"
    spoil(tiny("speaks", speaks=CATALOGUE), folder)
    tier = LocalTier(config(tiny("terse")), CATALOGUE)
    await tier.start()
    try:
        await tier.propose(about("Rover_1: go to dock 1"))
        before = tier.pid
        with pytest.raises(error, match=said) as caught:
            await tier.swap(str(folder))
        assert caught.value.remedy
        assert (tier.pid, tier.model, tier.status.state) == (before, "terse", "ready")
        assert (await tier.propose(about("Rover_1: hold"))).plan.subtasks
    finally:
        await tier.close()


async def test_only_one_swap_at_a_time_and_a_cancelled_one_leaves_nothing(tiny: Callable[..., Path]) -> None:
    """A second swap is refused while one is under way; a swap that is called off ends the process it began."""
    tier = LocalTier(config(tiny("terse")), CATALOGUE)
    await tier.start()
    try:
        await tier.propose(about("Rover_1: go to dock 1"))
        first = asyncio.create_task(tier.swap(str(tiny("other", seed=11))))
        await asyncio.sleep(0.05)
        with pytest.raises(RefusedError, match="already"):
            await tier.swap(str(tiny("other", seed=11)))
        first.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await first
        assert tier.model == "terse"
        assert (await tier.propose(about("Rover_1: hold"))).plan.subtasks
        assert len(await tier.swap(str(tiny("other", seed=11)))) == 3
    finally:
        await tier.close()


async def test_a_gateway_without_a_model_can_be_given_one(tiny: Callable[..., Path]) -> None:
    """The cascade has the local tier first from then on, tells its model, and refuses a folder that is none."""
    given = config(Path("/unset"), tiers=("local", "rules"))
    from msgspec.structs import replace  # noqa: PLC0415

    decomposer = Decomposer(replace(given, local_model="", run_confidence=0.0), CATALOGUE)
    await decomposer.start()
    try:
        assert decomposer.tiers == ("rules",)
        with pytest.raises(PrerequisiteError):
            await decomposer.swap("/nonexistent/model")
        assert decomposer.tiers == ("rules",)
        swapped = await decomposer.swap(str(tiny("terse")))
        assert (swapped.before, swapped.after) == ("", "terse")
        assert decomposer.tiers == ("local", "rules")
        assert decomposer.models == ("local:terse", "rules")
        slot = decomposer.status.slot
        assert slot is not None
        assert slot.state == "ready"
    finally:
        await decomposer.close()


async def test_a_deadline_breaks_an_answer_off(tiny: Callable[..., Path]) -> None:
    """The cascade's deadline ends the work in the process too."""
    tier = LocalTier(config(tiny("wordy", like=',"'), local_deadline_s=0.3), CATALOGUE)
    await tier.start()
    try:
        with pytest.raises(DeadlineError):
            await tier.propose(about("Rover_1: go to dock 1"))
        assert tier.status.restarts == 0
    finally:
        await tier.close()
