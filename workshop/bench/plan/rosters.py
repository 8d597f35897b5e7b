"""How plans, confidence and time change with the size of the fleet: the same orders to fleets of 2 to 256 robots.

Each fleet has rovers and drones half and half, `rover_5` and `drone_1` always among them, so that every order can be
given to every fleet. What is right follows from the fleet: "all drones" are each of its drones and no other, "a drone"
is one of them, and a plan of more subtasks than one may have is refused. An order to a robot that nobody named is right
when the plan leaves the choice open or takes one of those meant; it is held where there are several.
"""

import time
from collections import Counter
from collections.abc import Sequence
from statistics import mean
from typing import Any

import msgspec
from msgspec import Struct

from appliance.errors import PlanError
from appliance.llm.cascade import Decomposer
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.model import MAX_SUBTASKS, Plan, RobotInfo
from appliance.skills.catalogue import load_catalogue
from workshop.bench.figures import quantile
from workshop.bench.intent.cases import robot

SIZES = (2, 4, 8, 16, 32, 64, 128, 256)
REPEATS = 3
"""Times that each order is planned; nothing is cached."""


class Order(Struct, frozen=True):
    """An instruction, and what each step of its plan is: skill, and who does it."""

    instruction: str
    steps: tuple[tuple[str, str], ...]
    """A robot, `any`, `drones` or `rovers` (each of them), `a drone`, `a rover`; `-` for what no robot does."""


ORDERS = (
    Order("rover_5: go to dock 1, then photograph the shelf", (("goto", "rover_5"), ("photograph", "rover_5"))),
    Order(
        "rover_5 fetches the red box from dock 3 while drone_1 films the aisle for a minute",
        (("goto", "rover_5"), ("pick", "rover_5"), ("record_video", "drone_1")),
    ),
    Order("Drone 1 takes off, then it photographs the gate", (("takeoff", "drone_1"), ("photograph", "drone_1"))),
    Order("go to dock 1, then photograph the shelf", (("goto", "any"), ("photograph", "any"))),
    Order("film the gate for 30 seconds and send a report to the operator", (("record_video", "any"), ("report", "-"))),
    Order("a drone photographs the gate", (("photograph", "a drone"),)),
    Order("rover_5 goes to dock 1 and a drone films the aisle", (("goto", "rover_5"), ("record_video", "a drone"))),
    Order("all drones return home", (("return_home", "drones"),)),
    Order("all rovers go to dock 2, then photograph the shelf", (("goto", "rovers"), ("photograph", "rovers"))),
    Order(
        "every drone photographs the roof, then send a report to the operator",
        (("photograph", "drones"), ("report", "-")),
    ),
)


def fleet(size: int) -> tuple[RobotInfo, ...]:
    """Return a fleet of so many robots, from 2 on: rovers and drones half and half."""
    rovers = size - size // 2
    numbers = sorted([5, *(each for each in range(1, rovers + 1) if each != 5)][:rovers])
    names = [*(f"rover_{each}" for each in numbers), *(f"drone_{each}" for each in range(1, size // 2 + 1))]
    return tuple(robot(each) for each in names)


def is_right(order: Order, plan: Plan | None, robots: Sequence[RobotInfo]) -> bool:
    """Whether a plan has the steps of an order, each done by those who are meant and by no other.

    None, no plan, is right where it would have more subtasks than one may have.
    """
    kinds = {kind: [each.id for each in robots if each.id.startswith(kind)] for kind in ("drone", "rover")}
    meant: dict[str, list[str | None]] = {
        "-": [None],
        "any": ["any", *(each.id for each in robots)],
        "a drone": [*kinds["drone"]],
        "a rover": [*kinds["rover"]],
    }
    wanted = [
        (skill, meant.get(each, [each]))
        for skill, who in order.steps
        for each in (kinds[who[:-1]] if who in ("drones", "rovers") else [who])
    ]
    if len(wanted) > MAX_SUBTASKS or plan is None:
        return len(wanted) > MAX_SUBTASKS and plan is None
    left = [(each.skill, each.robot) for each in plan.subtasks]
    for skill, who in wanted:
        found = next((each for each in left if each[0] == skill and each[1] in who), None)
        if found is None:
            return False
        left.remove(found)
    return not left


async def by_size(
    config: LlmConfig, *, sizes: Sequence[int] = SIZES, repeats: int = REPEATS
) -> dict[str, dict[str, Any]]:
    """Give the orders to fleets of several sizes.

    Args:
        config: the planner's.
        sizes: robots of each fleet, from 2 on.
        repeats: times that each order is planned.

    Returns:
        By size: `orders`; `right`, percent; `run`, `held` and `refused`, how many; `confidence`, mean and least, of
        those that were planned; `latency_ms`, p50 and p99 of all.
    """
    decomposer = Decomposer(msgspec.structs.replace(config, cache=0), load_catalogue())
    await decomposer.start()
    rows: dict[str, dict[str, Any]] = {}
    try:
        await _warm(decomposer)
        for size in sizes:
            robots = fleet(size)
            right, decided = 0, Counter[str]()
            sure: list[float] = []
            times: list[float] = []
            for order in ORDERS:
                plan = None
                for _ in range(repeats):
                    began = time.monotonic()
                    plan = await _plan(decomposer, PlanContext(instruction=order.instruction, robots=robots))
                    times.append(1000 * (time.monotonic() - began))
                right += is_right(order, plan, robots)
                first = plan.provenance if plan is not None else None
                decided["refused" if plan is None else "held" if first is not None and first.confirm else "run"] += 1
                sure += [plan.confidence] if plan is not None else []
            times.sort()
            rows[str(size)] = {
                "orders": len(ORDERS),
                "right": round(100 * right / len(ORDERS), 1),
                **{verdict: decided[verdict] for verdict in ("run", "held", "refused")},
                "confidence": {
                    "mean": round(mean(sure), 3) if sure else None,
                    "least": round(min(sure), 3) if sure else None,
                },
                "latency_ms": {"p50": round(quantile(times, 0.5), 1), "p99": round(quantile(times, 0.99), 1)},
            }
    finally:
        await decomposer.close()
    return rows


async def _warm(decomposer: Decomposer) -> None:
    """Have a model loaded and its first answer given before anything is timed."""
    await _plan(decomposer, PlanContext(instruction=ORDERS[0].instruction, robots=fleet(2)))


async def _plan(decomposer: Decomposer, context: PlanContext) -> Plan | None:
    try:
        return (await decomposer.plan(context)).plan
    except PlanError:
        return None
