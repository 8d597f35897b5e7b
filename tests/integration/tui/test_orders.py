"""Orders of the terminal UI about tasks, given by key or line to one real fleet that does them.

What came of it is asked of the fleet itself, by a client that has no part in the terminal UI.
"""

import pytest
from moving_bench import counting

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.model import Approval, Plan, Subtask, SubtaskState, TaskRequest, TaskState
from appliance.tui.screens.review import ReviewScreen
from appliance.tui.screens.takeover import TakeoverScreen
from appliance.tui.widgets.dialogs import ConfirmDialog

from .operating import Operator, does, operator
from .ordering import ENDLESS, confirm, final, proposed, record_of, running, select

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.usefixtures("watched")]


# --- tasks -------------------------------------------------------------------------------------------------------


@does("submit")
async def test_submit(ann: Operator, client: FleetClient) -> None:
    """An instruction is planned, the plan is seen, and Enter runs exactly that one, in the operator's name."""
    await ann.line("submit rover_2: go to dock 1")
    await ann.see("Instruction", "rover_2: go to dock 1")
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
@pytest.mark.long
async def test_the_order_of_a_plan_is_edited(ann: Operator, client: FleetClient) -> None:
    """What comes after what is changed, taken back and begun again; each draft is checked, and the last one runs."""
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


async def test_the_estimate_of_a_plan_that_waits(ann: Operator, client: FleetClient) -> None:
    """`v` in the review says where the plan goes, how far and how long, and that it is an estimate; nothing moves."""
    record = await proposed(ann, client)
    await ann.press("v")
    await ann.see(":estimate", "goto", "m/s (", "about", "nothing was simulated")
    assert (await client.task(record.id)).state is TaskState.PROPOSED
    await ann.press("escape")
    await client.reject(record.id)


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


@does("duplicate")
async def test_duplicate(ann: Operator, client: FleetClient) -> None:
    """What was done is done once more, as a task of its own, in the name of who asks for it; the first stays."""
    await client.submit(TaskRequest(instruction="rover_2: go to dock 1", id="t-first", submitter="bob", priority=7))
    assert (await record_of(client, "t-first", final)).state is TaskState.SUCCEEDED
    await select(ann, "t-first")
    known = set(ann.store.tasks)
    await ann.press("D")
    await confirm(ann, "once more")
    await ann.until(lambda: set(ann.store.tasks) - known)
    (task,) = set(ann.store.tasks) - known
    record = await record_of(client, task, final)
    assert record.state is TaskState.SUCCEEDED, record.failure
    assert (record.instruction, record.submitter, record.priority) == ("rover_2: go to dock 1", "ann", 7)


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


@does("first")
async def test_a_task_is_put_before_others(ann: Operator, client: FleetClient) -> None:
    """By its key, among those that wait for one robot; the record says who has done it."""
    orders = {
        "t-far": "go to dock 4, then go to dock 1, then go to dock 4",
        "t-a": "go to dock 2",
        "t-b": "go to dock 3",
    }
    for task, words in orders.items():
        await client.submit(TaskRequest(instruction=f"rover_1: {words}", id=task))
    await record_of(client, "t-b", lambda record: record.subtasks)
    await select(ann, "t-b")
    await ann.press("u")
    record = await record_of(client, "t-b", lambda record: record.ranked_by)
    assert record.ranked_by is not None
    assert record.ranked_by.by == "ann"
    assert 0 < record.place_ns < record.created_ns
    for task in orders:
        await client.cancel(task)


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
    await confirm(ann, "Retry task t-again?")
    await record_of(client, "t-again", running)
    await ann.line("cancel t-again one of them is enough")
    await confirm(ann, "Cancel task t-again?")
    await record_of(client, "t-again", final)
    await ann.line("retry-subtask t-again/s2 this one")
    await confirm(ann, "Retry t-again/s2?")
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
        await loser.see("another operator was faster", f"{record.decision.by} has approved")
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
