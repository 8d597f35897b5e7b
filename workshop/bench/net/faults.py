"""What a bad wire does to a frame, and which faults a run goes through. Pure."""

import random
from collections.abc import Sequence

from msgspec import Struct

from appliance.errors import ConfigError


class Rule(Struct, frozen=True, kw_only=True):
    """What happens to frames from one port to another; meant and named as in tc-netem(8)."""

    loss: float = 0.0
    """Share of frames that never arrive."""
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    """Each frame is delayed by `delay_ms` plus or minus as much as this (even); so they may overtake each other."""
    reorder: float = 0.0
    """Share of frames that are sent at once instead of being delayed."""
    cut: bool = False
    """Nothing arrives."""


CLEAN = Rule()


def due_s(rule: Rule, now_s: float, generator: random.Random) -> float | None:
    """Return when a frame that comes now is to be sent on; None: never."""
    if rule.cut or (rule.loss and generator.random() < rule.loss):
        return None
    if not rule.delay_ms or (rule.reorder and generator.random() < rule.reorder):
        return now_s
    return now_s + max(0.0, rule.delay_ms + generator.uniform(-rule.jitter_ms, rule.jitter_ms)) / 1e3


Table = dict[str, dict[str, Rule]]
"""From port, to port; what is not in it is clean."""

PARTITION = "partition"
FAULTS = ("loss", "delay", "reorder", "oneway", PARTITION)


class Phase(Struct, frozen=True, kw_only=True):
    """A fault and for how long."""

    name: str
    at_s: float
    until_s: float
    table: Table
    sides: tuple[tuple[str, ...], ...] = ()
    """Of a partition: who still sees whom."""


FAULT_S = {"loss": 40.0, "delay": 40.0, "reorder": 30.0, "oneway": 30.0, "partition": 60.0}
"""How long each lasts in a full run."""
REST_S = 15.0


def table_of(
    fault: str, gateways: Sequence[str], *, generator: random.Random
) -> tuple[Table, tuple[tuple[str, ...], ...]]:
    """Return the rules of a fault between gateways, and the sides of a partition.

    loss: 5 % of all frames. delay: 100 ms ± 50. reorder: 25 % of the frames overtake the others, which are delayed by
    20 ms. oneway: what one gateway sends reaches no other, while it hears them all. partition: two halves.

    Raises:
        ConfigError: there is no such fault.
    """
    names = list(gateways)

    def between(rule: Rule, senders: Sequence[str], receivers: Sequence[str]) -> Table:
        return {one: {other: rule for other in receivers if other != one} for one in senders}

    match fault:
        case "loss":
            return between(Rule(loss=0.05), names, names), ()
        case "delay":
            return between(Rule(delay_ms=100.0, jitter_ms=50.0), names, names), ()
        case "reorder":
            return between(Rule(delay_ms=20.0, reorder=0.25), names, names), ()
        case "oneway":
            return between(Rule(cut=True), [generator.choice(names)], names), ()
        case "partition":
            generator.shuffle(names)
            one, other = names[: len(names) // 2], names[len(names) // 2 :]
            cut = Rule(cut=True)
            return between(cut, one, other) | between(cut, other, one), (tuple(sorted(one)), tuple(sorted(other)))
        case _:
            raise ConfigError(f"there is no fault {fault[:40]!r}", remedy=f"there are: {', '.join(FAULTS)}")


def phases(
    faults: Sequence[str],
    gateways: Sequence[str],
    *,
    fault_s: float,
    rest_s: float,
    seed: int,
    cuts_s: Sequence[float] = (),
) -> tuple[Phase, ...]:
    """Return the faults one after the other, with rests between them, the same for the same seed.

    Args:
        faults: their names, in order.
        gateways: the ports between which they are.
        fault_s: how long each lasts; 0: as long as `FAULT_S` says.
        rest_s: how long the wire is clean before each, and at the end.
        seed: of who is cut off.
        cuts_s: how long each of several partitions lasts, between the same sides, where `fault_s` does not say it.
    """
    generator = random.Random(seed)  # noqa: S311 - a mixture, not secrets
    found: list[Phase] = []
    at_s = rest_s
    for fault in faults:
        table, sides = table_of(fault, gateways, generator=generator)
        lengths = cuts_s if fault == PARTITION and cuts_s and not fault_s else (fault_s or FAULT_S[fault],)
        for length_s in lengths:
            until_s = at_s + length_s
            found.append(Phase(name=fault, at_s=at_s, until_s=until_s, table=table, sides=sides))
            at_s = until_s + rest_s
    return tuple(found)
