"""What a chaos run does, fixed beforehand by its seed: the tasks, and which gateway is down when. Pure."""

import random
from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from appliance.model import Plan, Subtask

SKILL = "bench_ledger"
FaultKind = Literal["kill", "freeze"]


class Wanted(Struct, frozen=True, kw_only=True):
    """A task that is handed in `at_s` seconds after the beginning."""

    task: str
    at_s: float
    plan: Plan

    def entries(self) -> dict[str, tuple[str, ...]]:
        """What the ledger must hold of it in the end, by subtask, in order."""
        return {
            each.id: tuple(entry(self.task, each.id, step) for step in range(int(each.params["steps"])))
            for each in self.plan.subtasks
        }


class Outage(Struct, frozen=True, kw_only=True):
    """A gateway that is gone for a while: killed and started again, or stopped (SIGSTOP) and let go on."""

    gateway: str
    kind: FaultKind
    at_s: float
    until_s: float


def entry(task: str, subtask: str, step: int) -> str:
    """Return the name of one effect."""
    return f"{task}/{subtask}#{step}"


def tasks(count: int, *, seconds: float, robots: Sequence[str], prefix: str, seed: int) -> tuple[Wanted, ...]:
    """Return tasks handed in over `seconds`, the same for the same seed.

    Each has 2 to 5 subtasks; a later one comes after earlier ones with probability 0.6; each makes 1 to 5 effects
    with pauses between them; a third of them save a checkpoint after each effect.

    Args:
        count: how many.
        seconds: over which time they are handed in, evenly at random.
        robots: the ledgers that subtasks write to.
        prefix: of the tasks' ids.
        seed: of the generator.
    """
    generator = random.Random(seed)  # noqa: S311 - a mixture, not secrets
    times = sorted(generator.uniform(0.0, seconds) for _ in range(count))
    return tuple(
        Wanted(task=task, at_s=at_s, plan=_plan(generator, task, robots))
        for at_s, task in ((at_s, f"{prefix}{number:04d}") for number, at_s in enumerate(times))
    )


def _plan(generator: random.Random, task: str, robots: Sequence[str]) -> Plan:
    subtasks: list[Subtask] = []
    for number in range(generator.randint(2, 5)):
        before = [each.id for each in subtasks if generator.random() < 0.5] if generator.random() < 0.6 else []
        name = f"s{number + 1}"
        subtasks.append(
            Subtask(
                id=name,
                skill=SKILL,
                robot=generator.choice(list(robots)),
                after=tuple(before),
                params={
                    "name": f"{task}/{name}",
                    "steps": generator.randint(1, 5),
                    "pause_ms": generator.randint(20, 1000),
                    "save": "each" if generator.random() < 1 / 3 else "never",
                },
            )
        )
    return Plan(domain="coordination", subtasks=tuple(subtasks))


def outages(
    gateways: Sequence[str], *, seconds: float, most: int, every_s: float, freezes: float, seed: int
) -> tuple[Outage, ...]:
    """Return who is down when, the same for the same seed; never more than `most` at once.

    Args:
        gateways: those there are.
        seconds: until when somebody may go down; nobody is down for more than 8 s.
        most: how many may be down at once.
        every_s: mean time between outages (exponential).
        freezes: share of outages in which the gateway is only stopped for 0.3 to 4 s and then goes on.
        seed: of the generator.
    """
    generator = random.Random(seed)  # noqa: S311 - a mixture, not secrets
    found: list[Outage] = []
    at_s = generator.expovariate(1 / every_s)
    while at_s < seconds:
        # A gateway that was let go on or started counts as down for a second more: it has to come back to the ring.
        down = [each.gateway for each in found if each.until_s + 1.0 > at_s]
        up = [each for each in gateways if each not in down]
        if len(down) < most and up:
            kind: FaultKind = "freeze" if generator.random() < freezes else "kill"
            for_s = generator.uniform(0.3, 4.0) if kind == "freeze" else generator.uniform(0.5, 8.0)
            found.append(Outage(gateway=generator.choice(up), kind=kind, at_s=at_s, until_s=at_s + for_s))
        at_s += generator.expovariate(1 / every_s)
    return tuple(found)
