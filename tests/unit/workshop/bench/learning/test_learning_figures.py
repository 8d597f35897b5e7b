"""What cells show beside what was demanded: met, missed, invalid and not measured are told apart."""

from typing import Any

import pytest

from workshop.bench.learning import figures
from workshop.bench.learning.figures import Figure, reached_s
from workshop.bench.learning.store import Kept


def kept(kind: str, name: str, result: dict[str, Any], **settings: Any) -> Kept:
    """A cell's file."""
    return Kept(
        cell=name, kind=kind, settings={"workload": "clips", **settings}, result=result, finished="", took_s=1.0,
        load=(0.0, 0.0), cores=2,
    )  # fmt: skip


def found(name: str, *cells: Kept) -> Figure:
    """The figure of that name."""
    return next(each for each in figures.judge("clips", cells) if each.name == name)


def wall(*, exceeded: int = 0, **p50_s: float) -> Kept:
    """A wall cell of 16 clients: mode -> p50 of its rounds; nominal clients of the last mode took too long so often."""
    last = list(p50_s)[-1]
    runs = {
        mode: {
            "p50_s": each,
            "virtual_p50_s": each * 0.95,
            "nominal_runs": 100,
            "exceeded": exceeded if mode == last else 0,
            "valid": not exceeded or mode != last,
        }
        for mode, each in p50_s.items()
    }
    return kept("wall", "clips-wall-16", {"runs": runs}, clients=16)


def test_nothing_measured_misses_nothing() -> None:
    """Without cells each figure is there, without value and verdict."""
    shown = figures.judge("clips", [])
    assert len(shown) > 20
    assert all(each.met is None and each.value is None and each.note == "not measured" for each in shown)


def test_a_round_time_is_met_missed_or_invalid() -> None:
    """0.3 is met and 0.4 missed; where a nominal client took too long there is a value and no verdict."""
    name = "round time, partial / FedAvg, N = 16, by the clock"
    assert found(name, wall(sync=10.0, partial=3.0)).met is True
    assert found(name, wall(sync=10.0, partial=4.0)).met is False
    assert found("wall / virtual round time, sync, N = 16", wall(sync=10.0)).met is True
    invalid = found(name, wall(sync=10.0, partial=3.0, exceeded=2))
    assert (invalid.met, invalid.value) == (None, 0.3)
    assert "2 of 100" in invalid.note
    assert found(name, wall(sync=10.0)).note == "not measured"
    assert found(name, wall(sync=10.0, partial=3.0), kept("wall", "words", {}, workload="words")).met is True


def virtual(mode: str, seed: int, accuracy: float, own: float, ends_s: float) -> Kept:
    """A virtual cell with two evaluations."""
    curve = [
        {"round": 5, "at_s": ends_s / 2, "accuracy": accuracy / 2, "loss": 1.0, "own": own},
        {"round": 10, "at_s": ends_s, "accuracy": accuracy, "loss": 0.2, "own": own},
    ]
    return kept("virtual", f"clips-virtual-{mode}-seed{seed}", {"curve": curve}, mode=mode, seed=seed)


def test_accuracy_is_compared_seed_by_seed() -> None:
    """Seeds that one side lacks are left out; the mean of the differences counts."""
    cells = (
        virtual("sync", 1, 0.96, 0.98, 100.0), virtual("partial", 1, 0.958, 0.97, 30.0),
        virtual("sync", 2, 0.94, 0.98, 100.0), virtual("partial", 2, 0.936, 0.95, 30.0),
        virtual("partial", 3, 0.5, 0.5, 30.0),
    )  # fmt: skip
    final = found("final accuracy, partial - FedAvg", *cells)
    assert (final.value, final.met) == (pytest.approx(-0.3), True)
    own = found("accuracy on stragglers' own data, partial - FedAvg", *cells)
    assert (own.value, own.met) == (pytest.approx(-2.0), True)
    assert found("time to FedAvg's accuracy - 1 point, partial / FedAvg", *cells).met is True
    assert found("final accuracy, drop - FedAvg", *cells).note == "not measured"


def test_an_accuracy_that_is_never_reached_is_missed() -> None:
    """The time to an accuracy that the run did not come to is no number, and misses the goal."""
    cells = (virtual("sync", 1, 0.96, 0.98, 100.0), virtual("partial", 1, 0.9, 0.98, 30.0))
    late = found("time to FedAvg's accuracy - 1 point, partial / FedAvg", *cells)
    assert (late.value, late.met) == (None, False)


def test_when_a_curve_reaches_an_accuracy() -> None:
    """By a straight line between two evaluations, from nothing at the beginning; None beyond the last."""
    curve = [{"accuracy": 0.5, "at_s": 10.0}, {"accuracy": 0.9, "at_s": 20.0}]
    assert reached_s(curve, 0.25) == pytest.approx(5.0)
    assert reached_s(curve, 0.7) == pytest.approx(15.0)
    assert reached_s(curve, 0.95) is None


def test_a_takeover_without_a_next_step_is_missed() -> None:
    """The slowest of the kills counts; one after which no step was seen misses the goal; other digests do."""
    kills = [{"next_step_ms": 100.0, "same": True}, {"next_step_ms": 300.0, "same": True}]
    good = kept("takeover", "clips-takeover-before", {"kills": kills}, phase="before")
    assert found("coordinator killed before the sum: next step", good).value == 300.0
    assert found("coordinator killed before the sum: digests", good).met is True
    bad = [*kills, {"next_step_ms": None, "same": False}]
    missed = kept("takeover", "clips-takeover-before", {"kills": bad}, phase="before")
    assert found("coordinator killed before the sum: next step", missed).met is False
    assert found("coordinator killed before the sum: digests", missed).met is False
