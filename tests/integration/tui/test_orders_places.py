"""Orders of the terminal UI to robots, gateways and pools, given by key or line to one real fleet that does them.

What came of it is asked of the fleet itself, by a client that has no part in the terminal UI.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from moving_bench import counting

from appliance.after_stop import robots_of
from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import PayloadError, RefusedError
from appliance.model import Approval, ContainerState, Plan, RobotInfo, Subtask, TaskRequest, TaskState
from appliance.operations import left_of, maintain, put_down_here, schedule_add
from appliance.pool.images import reference
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue
from appliance.tui.screens.takeover import TakeoverScreen

from .conftest import LAME
from .operating import LONG_S, Operator, does
from .ordering import TOUR, confirm, final, record_of

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.usefixtures("watched")]


# --- robots ------------------------------------------------------------------------------------------------------


def rover(client: FleetClient, name: str = "rover_1") -> RobotInfo:
    """Return a rover as it tells itself."""
    return client.plane.registry.robots[name]


@does("takeover", "release-robot")
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
    await confirm(ann, "Lift the soft stop of rover_2?", "Reason: gone")
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


@does("cancel", "put-down", "bring-back")
async def test_what_a_cancelled_task_leaves_is_put_down_or_brought_back(ann: Operator, client: FleetClient) -> None:
    """A robot that holds something says so on its task and in the CLI's words, puts it down here, or brings it back."""
    task = "t-left"
    steps = [("goto", {"place": "dock 1"}), ("pick", {"object": "blue box"})]
    steps += [("goto", {"place": place}) for place in ("dock 3", "dock 1") * 5]
    chain = tuple(
        Subtask(id=f"s{n}", skill=skill, robot="rover_1", params=dict(params), after=(f"s{n - 1}",) if n else ())
        for n, (skill, params) in enumerate(steps)
    )
    await client.submit(
        TaskRequest(instruction="fetch the blue box", id=task, plan=Plan(domain="manipulation", subtasks=chain))
    )
    await ann.until(lambda: rover(client).holding == "blue box")
    await ann.line(f"cancel {task} wrong box")
    await confirm(ann, f"Cancel task {task}?")
    await record_of(client, task, final)
    await ann.press("2", "enter")
    await ann.see("rover_1 stands at", "holds the blue box", ":put-down rover_1", f":retry {task}")
    (found,) = await left_of(client, robots_of(await client.task(task)), record=await client.task(task))
    assert (found.holding, found.offers[1].do) == ("blue box", "bring_it_back")

    await ann.line("bring-back rover_1")
    await confirm(ann, "Have rover_1 bring what it holds")
    await ann.until(lambda: not rover(client).holding)
    (newest, *_) = (await client.tasks(1)).tasks
    record = await record_of(client, newest.id, final)
    assert record.state is TaskState.SUCCEEDED, record.failure
    assert [each.subtask.params["place"] for each in record.subtasks if each.subtask.skill == "goto"] == ["dock 1"]

    pick = Subtask(id="s1", skill="pick", robot="rover_1", params={"object": "blue box"})
    plan = Plan(domain="manipulation", subtasks=(pick,))
    await client.submit(TaskRequest(instruction="pick it up", id="t-pick", plan=plan))
    await ann.until(lambda: rover(client).holding == "blue box")
    await ann.press("3", "home")
    await ann.until(lambda: ann.chosen.get("robot") == "rover_1")
    await ann.press("d")
    await confirm(ann, "Have rover_1 put down what it holds")
    await ann.until(lambda: not rover(client).holding)
    with pytest.raises(RefusedError, match="rover_1 holds nothing"):
        await put_down_here(client, "rover_1")


async def _stops(client: FleetClient, count: int) -> bool:
    """Whether so many soft stops are in force."""
    return len((await client.standing()).active) == count


@does("maintain", "end-maintenance", "close-place", "open-place")
async def test_robots_and_places_out_of_use(ann: Operator, client: FleetClient) -> None:
    """A robot goes into maintenance until a time and back, a place is closed and opened; the screen lists both."""
    await ann.press("3", "home")
    await ann.until(lambda: ann.chosen.get("robot") == "rover_1")
    await ann.line("maintain rover_1 new wheels")
    await confirm(ann, "Take rover_1 into maintenance?")
    await ann.hears("rover_1 is in maintenance by ann: new wheels")
    await ann.line('close-place "dock 3" flooded')
    await confirm(ann, "Close dock 3?")
    await ann.press("S")
    await ann.see("◌ closed", "dock 3", "flooded", "◌ maint.", "rover_1", "new wheels")
    found = {each.name: each for each in (await client.closures()).closures}
    assert [(found[name].until_ns, found[name].by.why) for name in ("dock 3", "rover_1")] == [
        (0, "flooded"),
        (0, "new wheels"),
    ]
    assert (await maintain(client, "rover_1", why="2h new wheels")).value.until_ns > time.time_ns()
    await ann.press("tab")
    await ann.until(lambda: ann.chosen.get("place") == "dock 3")
    await ann.press("o")
    await confirm(ann, "Open dock 3?")
    await ann.hears("dock 3 is open")
    await ann.until(lambda: ann.chosen.get("robot") == "rover_1")
    await ann.press("e")
    await confirm(ann, "End the maintenance of rover_1?")
    await ann.see("nothing is out of use")
    assert not (await client.closures()).closures


@does("add-rule", "remove-rule")
async def test_a_standing_rule_in_words(ann: Operator, client: FleetClient) -> None:
    """It is read back before it is added, listed, and removed from its row; none is added half read."""
    await ann.line("add-rule rover_1 never goes to dock 3 between 22:00 and 06:00")
    await confirm(ann, "rover_1:", "22:00")
    await ann.hears("rover_1: never go to dock 3")
    (added,) = (await client.closures()).rules
    assert (added.rule is not None and added.rule.places, added.by.by) == (("dock 3",), "ann")
    await ann.line("add-rule no robot flies over dock 3")
    await ann.see("not what they pass")
    assert (await client.closures()).rules == (added,)
    await ann.press("S")
    await ann.see("◌ rule", "rover_1:")
    await ann.press("tab")
    await ann.until(lambda: ann.chosen.get("rule") == added.name)
    await ann.press("R")
    await confirm(ann, f"Remove standing rule {added.name}?")
    await ann.see("nothing is out of use")
    assert not (await client.closures()).rules


@does("schedule-add", "schedule-pause", "schedule-resume", "schedule-remove")
async def test_a_schedule_from_its_screen(ann: Operator, client: FleetClient) -> None:
    """It is added with its interval, paused, resumed and removed; one that is never due is refused with the reason."""
    await ann.press("S", "n")
    await ann.write("1h rover_2: go to dock 2")
    await ann.press("enter")
    await confirm(ann, "Add a schedule, 1h: rover_2: go to dock 2?")
    await ann.see("rover_2-go-to-dock-2", "every 1h", "✔ active")
    await ann.until(lambda: ann.chosen.get("schedule") == "rover_2-go-to-dock-2")
    await ann.press("p")
    await ann.see("‖ paused")
    (shown,) = (await client.schedules()).schedules
    assert (shown.schedule.spec.every_s, shown.schedule.added.by) == (3600.0, "ann")
    await ann.press("r")
    await ann.see("✔ active")
    await ann.press("x")
    await confirm(ann, "Remove schedule rover_2-go-to-dock-2?")
    await ann.see("no schedules")
    assert not (await client.schedules()).schedules
    with pytest.raises(PayloadError, match="too short"):
        await schedule_add(client, "1s", "rover_2: go to dock 2")


# --- gateways and pools ------------------------------------------------------------------------------------------


@does("drain", "uncordon")
async def test_drain_and_undrain(ann: Operator, client: FleetClient) -> None:
    """A drained gateway says so of itself and gets no run; undrained it is as before."""
    await ann.press("1", "home")
    await ann.until(lambda: ann.chosen.get("gateway") == "gw-1")
    await ann.until(lambda: ann.store.gateways["gw-1"].latency_ms is not None)
    await ann.line("drain gw-1 its fan is loud")
    await confirm(ann, "Drain gw-1?", "fan is loud")
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
    await confirm(ann, f"Evict {victim}?")
    await ann.hears("evicted")
    await ann.until(lambda: victim not in client.plane.registry.containers.get("gw-2", {}))
    await ann.line("audit")
    await ann.see("pool evict", "pool warm", "ann")


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
    await ann.hears(f"gw-1: {LAME} released")
    await ann.line(f"warm {LAME} 1 gw-1")
    await ann.hears(f"gw-1: 1 of {LAME} ready")
    await ann.line(f"evict {LAME} gw-1")
    await confirm(ann, f"Evict {LAME}?")
    await ann.hears("evicted")


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


# --- alerts ------------------------------------------------------------------------------------------------------


@does("ack", "ack-all")
async def test_acknowledge_alerts(ann: Operator, client: FleetClient) -> None:
    """One by its key and the others after a question; who has done it, and why, is known to the whole fleet."""
    for name in ("t-held-1", "t-held-2"):
        await client.submit(
            TaskRequest(instruction="rover_1: go to dock 2", id=name, approval=Approval.ALWAYS),
        )
    await ann.press("exclamation_mark")
    await ann.until(lambda: {"plan-waits.t-held-1", "plan-waits.t-held-2"} <= set(ann.store.alerts))
    await ann.line("ack plan-waits.t-held-1 a look at noon")
    await ann.until(lambda: ann.store.acked("plan-waits.t-held-1"))
    await ann.line("ack-all it is late")
    await confirm(ann, "Acknowledge all alerts")
    await ann.until(lambda: all(each.acked is not None for each in ann.store.alerts.values()))
    words = {each.id: each.acked for each in (await client.alerts()).alerts}
    first, second = words["plan-waits.t-held-1"], words["plan-waits.t-held-2"]
    assert first is not None
    assert second is not None
    assert (first.by, first.why, second.why) == ("ann", "a look at noon", "it is late")
    for name in ("t-held-1", "t-held-2"):
        await client.cancel(name)
    await ann.until(lambda: not {"plan-waits.t-held-1", "plan-waits.t-held-2"} & set(ann.store.alerts))
