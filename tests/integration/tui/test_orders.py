"""Each order of the terminal UI that changes something, given by key or line to one real fleet that does it.

What came of it is asked of the fleet itself, by a client that has no part in the terminal UI.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
from moving_bench import counting, pretty

from appliance.client import FleetClient
from appliance.local_fleet import FleetState
from appliance.model import (
    Approval,
    ContainerState,
    Plan,
    RobotInfo,
    Subtask,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
)
from appliance.pool.images import reference
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue
from appliance.tui.actions import BY_NAME
from appliance.tui.dialogs import ConfirmDialog
from appliance.tui.robots.takeover import TakeoverScreen
from appliance.tui.tasks.review import ReviewScreen

from .conftest import LAME
from .operating import AUDITED, LONG_S, WATCHED, Operator, does, operator

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.fleet]

ENDLESS = 4000
"""Steps of a run that is ended before it has made them."""
TOUR = "rover_1: go to dock 3, then go to dock 2"


@pytest.fixture
async def client(fleet: FleetState) -> AsyncIterator[FleetClient]:
    """Return somebody else's eyes on the fleet."""
    async with FleetClient(fleet.endpoint, operator="eve") as made:
        yield made


@pytest.fixture(autouse=True)
async def watched(request: pytest.FixtureRequest, client: FleetClient) -> AsyncIterator[None]:
    """Hold a test to what it says it `does`: each action was done, and stands in the audit with who and why."""
    began_ns = time.time_ns()
    WATCHED.clear()
    yield
    wanted = getattr(request.function, "does", ())
    begun = {each for app in WATCHED for each in app.begun}
    done = {each for app in WATCHED for each in app.done}
    for name in wanted:
        assert name in (done if BY_NAME[name].do is not None else {action for action, _ in begun}), name
    names = {app.view.operator for app in WATCHED}
    verbs = {AUDITED[name] for name in wanted if name in AUDITED}
    whys = {(AUDITED[name], why) for name, why in begun if name in wanted and why}
    told: set[tuple[str, str]] = set()
    try:
        # What an order does can be seen before the gateway that it was given to has put it down.
        async with asyncio.timeout(LONG_S):
            while not (verbs <= {verb for verb, _ in told} and all(_is_told(each, told) for each in whys)):
                acts, _ = await client.acts(500)
                told = {(each.verb, each.why) for each in acts if each.by in names and each.at_ns >= began_ns
                        and each.outcome == "done"}  # fmt: skip
    except TimeoutError:
        pytest.fail(f"the audit has {told}, and should have {verbs}, {whys}")


def _is_told(order: tuple[str, str], told: set[tuple[str, str]]) -> bool:
    """Whether an order stands in the audit. What follows `:stop` and names no robot is why as well."""
    return any(verb == order[0] and why.endswith(order[1]) for verb, why in told)


@pytest.fixture
async def ann(fleet: FleetState) -> AsyncIterator[Operator]:
    """Return an operator at a terminal UI on it."""
    async with operator(fleet, "ann") as it:
        yield it


async def record_of(client: FleetClient, task: str, holds: Callable[[TaskRecord], object]) -> TaskRecord:
    """Wait until a task's record is so; after a minute, fail with how it is."""
    record: TaskRecord | None = None
    try:
        async with asyncio.timeout(LONG_S):
            while not holds(record := await client.task(task)):
                await asyncio.sleep(0.1)
    except TimeoutError:
        pytest.fail(f"it never came to be so: {pretty(record)}")
    return record


def running(record: TaskRecord) -> bool:
    """Whether a subtask of it runs. How far it is, a record tells no oftener than it is written for other reasons."""
    return any(each.state is SubtaskState.RUNNING for each in record.subtasks)


def final(record: TaskRecord) -> bool:
    """Whether it has ended."""
    return record.state.final


async def select(ann: Operator, task: str) -> None:
    """Go to a task on the screen of tasks."""
    await ann.press("2")
    await ann.until(lambda: task in ann.store.tasks)
    with ann.app._context():
        ann.app.show_task(task)
    await ann.until(lambda: ann.chosen.get("task") == task)


async def confirm(ann: Operator, *words: str) -> None:
    """Read a question, and say yes."""
    await ann.until(lambda: isinstance(ann.app.screen, ConfirmDialog))
    await ann.see(*words)
    await ann.press("y")


async def proposed(ann: Operator, client: FleetClient, instruction: str = TOUR) -> TaskRecord:
    """Submit an instruction for review; its record once the plan waits and is looked at."""
    known = set(ann.store.tasks)
    await ann.press("s")
    await ann.see("What shall the robots do?")
    await ann.write(instruction)
    await ann.press("enter")
    await ann.see("Enter runs this plan")
    await ann.press("f2")
    await ann.until(lambda: isinstance(ann.app.screen, ReviewScreen))
    (task,) = set(ann.store.tasks) - known
    record = await record_of(client, task, lambda record: record.state is TaskState.PROPOSED)
    await ann.see("waits for approval", "goto")
    return record


# --- tasks -------------------------------------------------------------------------------------------------------


@does("submit")
async def test_submit(ann: Operator, client: FleetClient) -> None:
    """An instruction is planned, the plan is seen, and Enter runs exactly that one, in the operator's name."""
    await ann.line("submit rover_2: go to dock 1")
    await ann.see("What shall the robots do?", "rover_2: go to dock 1")
    await ann.press("enter")
    await ann.see("Enter runs this plan", "goto", "rover_2")
    known = set(ann.store.tasks)
    await ann.press("enter")
    await ann.until(lambda: set(ann.store.tasks) - known)
    (task,) = set(ann.store.tasks) - known
    record = await record_of(client, task, final)
    assert record.state is TaskState.SUCCEEDED, record.failure
    assert (record.submitter, record.instruction) == ("ann", "rover_2: go to dock 1")
    assert [each.subtask.robot for each in record.subtasks] == ["rover_2"]


@does("edit-robot", "edit-params", "edit-out", "approve")
async def test_approve_an_edited_plan(ann: Operator, client: FleetClient) -> None:
    """Another robot, other parameters, one subtask fewer: checked, approved, and run so and not otherwise."""
    task = (await proposed(ann, client)).id
    await ann.press("home", "r")
    await ann.write("rover_2")
    await ann.press("enter")
    await ann.see("robot: rover_1 → rover_2", "checked")
    await ann.press("e")
    await ann.until(lambda: ann.app.front is not None and ann.app.front.prompt.writing)
    assert ann.app.front is not None
    ann.app.front.prompt.field.value = 'edit-params s1 place="dock 1"'
    await ann.press("enter")
    await ann.see("dock 1", "checked: it may run")
    await ann.press("end", "d")
    await ann.see("taken out", "checked: it may run")
    await ann.line("approve dock 3 is closed")
    await confirm(ann, "Approve the edited plan", "rover_2")
    record = await record_of(client, task, final)
    assert record.state is TaskState.SUCCEEDED, record.failure
    (step,) = [each.subtask for each in record.subtasks]
    assert (step.robot, step.params["place"]) == ("rover_2", "dock 1")
    assert record.decision is not None
    assert (record.decision.by, record.decision.edited, record.decision.why) == ("ann", True, "dock 3 is closed")


@does("edit-up", "edit-down", "edit-after", "edit-undo", "edit-reload", "approve")
async def test_the_order_of_a_plan_is_edited(ann: Operator, client: FleetClient) -> None:
    """What comes after what is changed, taken back and begun anew; each draft is checked, and the last one runs."""
    record = await proposed(ann, client, "rover_1: go to dock 3, then go to dock 2, then go to dock 1")
    steps = record.proposal.plan.subtasks if record.proposal is not None else ()
    assert [each.after for each in steps] == [(), ("s1",), ("s2",)]

    def after() -> list[tuple[str, ...]]:
        """What the draft on the screen has each subtask come after, in the order of their names."""
        assert isinstance(ann.app.screen, ReviewScreen)
        draft = ann.app.screen.draft
        return [draft.of_id(name).after for name in ("s1", "s2", "s3")] if draft is not None else []

    await ann.press("home", "right_square_bracket")
    await ann.see("checked: it may run")
    swapped = after()
    assert swapped != [(), ("s1",), ("s2",)]
    await ann.line("edit-up s1")
    await ann.until(lambda: after() == [(), ("s1",), ("s2",)])
    await ann.press("u")
    await ann.until(lambda: after() == swapped)
    await ann.line("edit-reload")
    await ann.until(lambda: after() == [(), ("s1",), ("s2",)])
    await ann.line("edit-after s1 s3")
    await ann.see("circle")
    assert after() == [(), ("s1",), ("s2",)]
    await ann.line("edit-after s3 s1")
    await ann.see("s2 and s3: rover_1 cannot do goto and goto at the same time")
    assert after() == [(), ("s1",), ("s1",)]
    await ann.line("edit-robot s3 rover_2")
    await ann.see("robot: rover_1 → rover_2", "checked: it may run")
    await ann.press("a")
    await confirm(ann, "Approve the edited plan")
    ended = await record_of(client, record.id, final)
    assert ended.state is TaskState.SUCCEEDED, ended.failure
    assert [ended.of(name).subtask.after for name in ("s1", "s2", "s3")] == [(), ("s1",), ("s1",)]
    assert [ended.of(name).subtask.robot for name in ("s1", "s2", "s3")] == ["rover_1", "rover_1", "rover_2"]


@does("reject")
async def test_reject(ann: Operator, client: FleetClient) -> None:
    """A plan that is turned down does not run, and the record says who did so."""
    task = (await proposed(ann, client)).id
    await ann.line("reject not today")
    await confirm(ann, "Reject the plan")
    record = await record_of(client, task, final)
    assert record.decision is not None
    assert (record.decision.by, record.decision.approved, record.decision.why) == ("ann", False, "not today")
    assert all(not each.attempts for each in record.subtasks)


@does("pause", "hold", "resume")
async def test_pause_hold_and_resume(ann: Operator, client: FleetClient) -> None:
    """Paused, nothing further begins; held, a run ends at its checkpoint; resumed, it goes on in a new attempt."""
    await client.submit(counting("t-hold", steps=ENDLESS))
    await record_of(client, "t-hold", running)
    await select(ann, "t-hold")
    await ann.press("p")
    await record_of(client, "t-hold", lambda record: record.paused)
    await ann.see("‖ paused")
    await ann.press("r")
    await confirm(ann, "Resume task t-hold?")
    await record_of(client, "t-hold", lambda record: not record.paused)
    await ann.line("hold t-hold a visitor")
    await confirm(ann, "Hold task t-hold?")
    record = await record_of(client, "t-hold", lambda record: record.paused and not running(record))
    assert record.paused == "paused by ann: a visitor"
    await ann.line("resume t-hold the visitor has left")
    await confirm(ann, "Resume task t-hold?")
    record = await record_of(client, "t-hold", lambda record: running(record) and record.of("s1").attempt == 2)
    assert not record.paused
    await client.cancel("t-hold")


@does("cancel", "retry", "retry-subtask")
async def test_cancel_and_retry(ann: Operator, client: FleetClient) -> None:
    """A cancelled task ends with who asked for it; tried again, whole or one subtask of it, it runs again."""
    await client.submit(counting("t-again", steps=ENDLESS, count=2))
    await record_of(client, "t-again", running)
    await select(ann, "t-again")
    await ann.press("c")
    await confirm(ann, "Cancel task t-again?")
    record = await record_of(client, "t-again", final)
    assert record.state is TaskState.CANCELLED
    assert record.cancelled_by is not None
    assert record.cancelled_by.by == "ann"
    await ann.see("cancelled")
    await ann.press("t")
    await confirm(ann, "Try task t-again again?")
    await record_of(client, "t-again", running)
    await ann.line("cancel t-again one of them is enough")
    await confirm(ann, "Cancel task t-again?")
    await record_of(client, "t-again", final)
    await ann.line("retry-subtask t-again/s2 this one")
    await confirm(ann, "Try t-again/s2 again?")
    record = await record_of(client, "t-again", running)
    assert (record.retries, record.of("s2").state) == (2, SubtaskState.RUNNING)
    await client.cancel("t-again")


@does("migrate")
async def test_migrate_by_hand(ann: Operator, client: FleetClient) -> None:
    """A run is moved to the other gateway with its checkpoint, and ends there."""
    await client.submit(counting("t-move", steps=ENDLESS, then=20))
    record = await record_of(client, "t-move", running)
    source = record.of("s1").gateway
    (target,) = {"gw-1", "gw-2"} - {source}
    await select(ann, "t-move")
    await ann.press("enter")
    await ann.until(lambda: ann.chosen.get("subtask") == "t-move/s1")
    await ann.line(f"migrate t-move/s1 {target} to see it move")
    await ann.hears(f"moved from {source} to {target}")
    record = await record_of(client, "t-move", final)
    assert record.state is TaskState.SUCCEEDED, record.failure
    assert record.of("s1").gateway == target
    assert (record.of("s1").result or {})["resumed_from"] > 0


@does("answer")
async def test_answer_a_question(ann: Operator, client: FleetClient) -> None:
    """What a skill asks is on the robot's line; the answer reaches the skill, which ends with it."""
    wait = Subtask(id="s1", skill="wait_for", robot="rover_1", params={"event": "the gate is open"})
    plan = Plan(domain="interaction", subtasks=(wait,))
    await client.submit(TaskRequest(instruction="wait", id="t-ask", plan=plan))
    await ann.press("3", "home")
    await ann.see("? asks")
    await ann.until(lambda: "enquiry" in ann.chosen)
    await ann.press("A")
    await ann.write("yes")
    await ann.press("enter")
    await ann.hears("answered:", "the gate is open", "yes")
    record = await record_of(client, "t-ask", final)
    assert (record.subtasks[0].result or {})["confirmed"] is True


# --- robots ------------------------------------------------------------------------------------------------------


def rover(client: FleetClient, name: str = "rover_1") -> RobotInfo:
    """Return a rover as it tells itself."""
    return client.plane.registry.robots[name]


@does("takeover", "give-back")
async def test_take_over_and_give_back(ann: Operator, client: FleetClient) -> None:
    """While a key is held the robot moves, nobody else's order does, and given back it is anybody's again."""
    await ann.press("3", "home")
    await ann.until(lambda: ann.chosen.get("robot") == "rover_1")
    await ann.line("takeover rover_1 to look behind it")
    await confirm(ann, "Take rover_1 over?")
    await ann.see("⇅ yours")
    before = rover(client).pose
    async with asyncio.timeout(LONG_S):
        while rover(client).pose == before:
            await ann.press("up")
            await asyncio.sleep(0.1)
    await client.submit(TaskRequest(instruction="rover_1: go to dock 2", id="t-wait"))
    await record_of(client, "t-wait", lambda record: record.subtasks and "taken over" in record.subtasks[0].note)
    await ann.press("g")
    await ann.until(lambda: not isinstance(ann.app.screen, TakeoverScreen))
    record = await record_of(client, "t-wait", final)
    assert record.state is TaskState.SUCCEEDED, record.failure
    acts, _ = await client.acts(20)
    assert {"control_take", "control_give"} <= {act.verb for act in acts if act.by == "ann"}


@does("stop-robot", "stop", "resume-robots")
async def test_stop_and_resume_one_robot(ann: Operator, client: FleetClient) -> None:
    """One key stops the robot under the cursor and no other; let go, after a question, it is free again."""
    await ann.press("3", "home")
    await ann.until(lambda: ann.chosen.get("robot") == "rover_1")
    await ann.press("x")
    await ann.hears("soft stop of rover_1", "holding: rover_1")
    await ann.see("■ stopped")
    (stop,) = (await client.standing()).active
    assert (stop.robots, stop.by) == (("rover_1",), "ann")
    await ann.press("z")
    await confirm(ann, "Lift the soft stop of rover_1?")
    await ann.hears("rover_1 may move again")
    assert not (await client.standing()).active
    await ann.line("stop rover_2 a person in the aisle")
    await ann.hears("soft stop of rover_2", "holding: rover_2")
    (stop,) = (await client.standing()).active
    assert (stop.robots, stop.by, stop.why) == (("rover_2",), "ann", "a person in the aisle")
    await ann.line("resume-robots rover_2 gone")
    await confirm(ann, "Lift the soft stop of rover_2?", "Why: gone")
    await ann.hears("rover_2 may move again")
    assert not (await client.standing()).active


@does("stop", "resume-robots", "resume-all")
async def test_stop_and_resume_the_fleet(ann: Operator, client: FleetClient) -> None:
    """F8 stops all robots, read-only too, and their tasks wait; lifting it needs unlocking, asks, and frees all."""
    await client.submit(TaskRequest(instruction=f"{TOUR}, then go to dock 3", id="t-stop"))
    await record_of(client, "t-stop", lambda record: any(each.attempt for each in record.subtasks))
    await ann.press("R", "f8")
    await ann.hears("soft stop of the fleet", "rover_1", "rover_2")
    record = await record_of(client, "t-stop", lambda record: record.paused)
    assert "ann" in record.paused
    await ann.line("resume-robots")
    await ann.see("read-only")
    assert (await client.standing()).active
    await ann.press("W")
    await ann.line("resume-robots")
    await confirm(ann, "Lift the soft stop of all robots?")
    await ann.hears("all robots may move again")
    assert not (await client.standing()).active
    record = await record_of(client, "t-stop", final)
    assert record.state is TaskState.SUCCEEDED, record.failure
    await ann.line("stop everybody out of the hall")
    await ann.until_true(lambda: _stops(client, 1))
    await ann.press("3", "Z")
    await confirm(ann, "Lift the soft stops of all robots?")
    await ann.until_true(lambda: _stops(client, 0))


async def _stops(client: FleetClient, count: int) -> bool:
    """Whether so many soft stops are in force."""
    return len((await client.standing()).active) == count


# --- gateways and pools ------------------------------------------------------------------------------------------


@does("drain", "undrain")
async def test_drain_and_undrain(ann: Operator, client: FleetClient) -> None:
    """A drained gateway says so of itself and gets no run; undrained it is as before."""
    await ann.press("1", "home")
    await ann.until(lambda: ann.chosen.get("gateway") == "gw-1")
    await ann.until(lambda: ann.store.gateways["gw-1"].latency_ms is not None)
    await ann.line("drain gw-1 its fan is loud")
    await confirm(ann, "Drain gw-1?", "its fan is loud")
    await ann.until(lambda: client.plane.registry.gateways["gw-1"].draining)
    await ann.see("◌ draining")
    await client.submit(counting("t-dry", steps=2))
    record = await record_of(client, "t-dry", final)
    assert record.of("s1").gateway == "gw-2"
    await ann.press("u")
    await ann.until(lambda: not client.plane.registry.gateways["gw-1"].draining)
    await ann.see("gw-1", without="◌ draining")


@does("warm", "evict")
async def test_warm_and_evict(ann: Operator, client: FleetClient) -> None:
    """Containers that are asked for get ready; the one under the cursor is given up, after a question."""

    def held() -> set[str]:
        known = client.plane.registry.containers.get("gw-2", {})
        return {name for name, each in known.items() if each.state is ContainerState.READY and "base" in each.image}

    await ann.press("4")
    await ann.line("warm base 3 gw-2 a tour comes")
    await ann.hears("gw-2: ", "of base ready")
    await ann.until(lambda: len(held()) >= 3)
    await ann.see("◔ start")
    await ann.until(lambda: any(each.gateway == "gw-2" for each in ann.store.containers.values()))
    await ann.press("end")
    await ann.until(lambda: ann.chosen.get("gateway") == "gw-2" and ann.chosen["container"] in held())
    victim = ann.chosen["container"]
    await ann.press("e")
    await confirm(ann, f"Give up {victim}?")
    await ann.hears("1 given up")
    await ann.until(lambda: victim not in client.plane.registry.containers.get("gw-2", {}))
    await ann.line("acts")
    await ann.see("pool_evict", "pool_warm", "ann")


@does("warm", "release", "evict")
async def test_quarantine_off(ann: Operator, client: FleetClient, broken: Callable[[], Awaitable[None]]) -> None:
    """An image that does not start is left alone with the reason; mended and released, containers of it start."""
    await ann.press("1")
    await ann.line(f"warm {LAME} 1 gw-1")
    await ann.until(lambda: "left alone" in client.plane.registry.gateways["gw-1"].pool_problem)
    await ann.see("✘ gw-1", "left alone")
    await ann.line("release base gw-1")
    await ann.hears("base is not in quarantine")
    await broken()
    await ann.line(f"release {LAME} gw-1 it is mended")
    await ann.hears("gw-1: started again")
    await ann.line(f"warm {LAME} 1 gw-1")
    await ann.hears(f"gw-1: 1 of {LAME} ready")
    await ann.line(f"evict {LAME} gw-1")
    await confirm(ann, f"Give up {LAME}?")
    await ann.hears("1 given up")


@does("fetch")
async def test_fetch_an_image(ann: Operator, fleet: FleetState) -> None:
    """A gateway is asked to have an image; on one machine it has what the others have, says so, and audits it."""
    await ann.line(f"fetch {reference(load_catalogue().images['base'], PoolConfig())} gw-2 to be sure")
    await ann.hears("is on gw-2")
    await ann.hears("image_fetch", "(to be sure)", "done")


@does("swap-model")
async def test_swap_the_model(ann: Operator, client: FleetClient, toy: Path, tmp_path: Path) -> None:
    """A model is tested before it takes over; then the gateway says that it plans with it. No model is refused."""
    await ann.press("5", "home")
    await ann.until(lambda: ann.chosen.get("gateway") == "gw-1")
    await ann.line(f"swap-model gw-1 {tmp_path}/nothing")
    await confirm(ann, "Have gw-1 plan with the model in")
    await ann.until(lambda: any(each.level == "error" and "nothing" in each.text for each in ann.store.entries))
    await ann.line(f"swap-model gw-1 {toy} it is small")
    await confirm(ann, "Have gw-1 plan with the model in")
    await ann.hears("gw-1 plans with toy instead of")
    await ann.until(
        lambda: (
            (planner := client.plane.registry.gateways["gw-1"].planner) is not None
            and planner.slot is not None
            and planner.slot.model == "toy"
        )
    )
    await ann.see("toy")


# --- two operators -----------------------------------------------------------------------------------------------


@does("approve", "pause", "takeover")
async def test_two_operators_one_winner(fleet: FleetState, client: FleetClient) -> None:
    """Both approve a plan, both pause a task, both take a robot: one does each time, the other hears who was faster."""
    instruction = "rover_2: go to dock 1"
    async with operator(fleet, "ann") as ann, operator(fleet, "bob") as bob:
        both = (ann, bob)
        await client.submit(TaskRequest(instruction=instruction, id="t-both", approval=Approval.ALWAYS))
        for each in both:
            await select(each, "t-both")
            await each.see("? approve")
            await each.press("a")
            await each.until(lambda each=each: isinstance(each.app.screen, ReviewScreen))
            await each.see("waits for approval")
            await each.press("a")
            await each.until(lambda each=each: isinstance(each.app.screen, ConfirmDialog))
        for each in both:
            await each.press("y")
        record = await record_of(client, "t-both", lambda record: record.decision is not None)
        assert record.decision is not None
        winner, loser = both if record.decision.by == "ann" else both[::-1]
        assert record.decision.by == winner.app.view.operator
        await winner.until(lambda: not isinstance(winner.app.screen, ReviewScreen))
        await loser.see("somebody was faster", f"{record.decision.by} has approved")
        assert isinstance(loser.app.screen, ReviewScreen)
        ended = await record_of(client, "t-both", final)
        assert ended.state is TaskState.SUCCEEDED, ended.failure
        assert [each.attempt for each in ended.subtasks] == [1]

        await client.submit(counting("t-pause", steps=ENDLESS))
        await record_of(client, "t-pause", running)
        for each in both:
            await each.until(lambda each=each: "t-pause" in each.store.tasks)
        for each in both:
            await each.line("pause t-pause")
        record = await record_of(client, "t-pause", lambda record: record.paused)
        (loser,) = [each for each in both if each.app.view.operator not in record.paused]
        await loser.hears(":pause t-pause", record.paused)
        await client.cancel("t-pause")

        for each in both:
            await each.line("takeover rover_2")
            await each.until(lambda each=each: isinstance(each.app.screen, ConfirmDialog))
        for each in both:
            await each.press("y")
        for each in both:
            await each.until(lambda each=each: isinstance(each.app.screen, TakeoverScreen))
        await ann.until(lambda: any("⇅ yours" in each.seen() for each in both))
        await ann.until(lambda: any("not under your hand" in each.seen() for each in both))
        winner, loser = both if "⇅ yours" in ann.seen() else both[::-1]
        await loser.see("not under your hand", f"taken over by {winner.app.view.operator}")
        for each in both:
            await each.press("escape")
        await client.cancel("t-pause") if not (await client.task("t-pause")).state.final else None
    acts, silent = await client.acts(100)
    assert not silent
    told = [(act.verb, act.outcome) for act in acts if act.by in ("ann", "bob") and act.target.startswith("t-both")]
    assert sorted(told) == [("approve", "conflict"), ("approve", "done")]
