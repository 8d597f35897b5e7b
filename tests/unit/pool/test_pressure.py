"""Memory pressure: what the kernel's files say, and the budget that follows."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.pool.pressure import Reading, Squeeze, parse_available, parse_stalls, reader
from appliance.pool.settings import PressureConfig

PSI = "some avg10=14.02 avg60=6.27 avg300=1.73 total=9123123\nfull avg10=3.50 avg60=1.00 avg300=0.20 total=123\n"
CALM = Reading(available_mb=4000.0, some=0.0, full=0.0)
TIGHT = Reading(available_mb=4000.0, some=14.0, full=1.0)
BETWEEN = Reading(available_mb=4000.0, some=5.0, full=1.0)


def test_the_worked_example() -> None:
    """It shrinks by a quarter of what is held, waits for that to show, and grows back step by step when it is calm."""
    squeeze = Squeeze(PressureConfig(), memory_mb=4096)
    assert squeeze.heard(TIGHT, held_mb=2048, now=0.0) == 1536
    assert squeeze.heard(TIGHT, held_mb=1536, now=1.0) == 1536
    assert squeeze.heard(TIGHT, held_mb=1536, now=3.0) == 1152
    assert "14 %" in squeeze.reason
    assert squeeze.steps == 2
    budgets = [squeeze.heard(CALM, held_mb=1152, now=float(now)) for now in range(4, 200)]
    assert sorted(set(budgets)) == [1152, 1664, 2176, 2688, 3200, 3712, 4096]
    assert budgets == sorted(budgets)
    assert squeeze.reason == ""


def test_between_the_marks_nothing_changes() -> None:
    """Neither high nor low: the budget stays, and the time of calm begins again."""
    squeeze = Squeeze(PressureConfig(), memory_mb=4096)
    squeeze.heard(TIGHT, held_mb=4096, now=0.0)
    for now in range(1, 200):
        # Calm for 19 s at a time is not calm enough.
        assert squeeze.heard(BETWEEN if now % 20 == 0 else CALM, held_mb=1000, now=float(now)) == 3072


def test_without_psi_available_memory_decides() -> None:
    """A kernel without PSI: the pool shrinks when little memory is available."""
    squeeze = Squeeze(PressureConfig(), memory_mb=1024)
    assert squeeze.heard(Reading(available_mb=300.0), held_mb=1024, now=0.0) == 1024
    assert squeeze.heard(Reading(available_mb=200.0), held_mb=1024, now=1.0) == 768
    assert "200 MB available" in squeeze.reason


def test_unknown_is_calm() -> None:
    """Where nothing can be read nothing is taken away."""
    squeeze = Squeeze(PressureConfig(), memory_mb=1024)
    assert squeeze.heard(Reading(), held_mb=1024, now=0.0) == 1024


@given(
    st.lists(
        st.tuples(st.floats(0, 100), st.floats(0, 100), st.floats(0, 10_000), st.integers(0, 4096), st.floats(0.1, 30)),
        max_size=60,
    ),
    st.integers(64, 4096),
)
def test_the_budget_stays_within_its_bounds(
    readings: list[tuple[float, float, float, int, float]], memory_mb: int
) -> None:
    """Whatever is read, the budget is never above the setting nor below the least, and a step has its pause."""
    config = PressureConfig()
    squeeze = Squeeze(config, memory_mb=memory_mb)
    now, before, changed_at = 0.0, memory_mb, -1000.0
    for some, full, available, held, pause in readings:
        now += pause
        budget = squeeze.heard(Reading(available_mb=available, some=some, full=full), held_mb=held, now=now)
        assert min(config.least_mb, memory_mb) <= budget <= memory_mb
        assert bool(squeeze.reason) == (budget < memory_mb)
        if budget != before:
            assert now - changed_at >= (config.settle_s if budget < before else config.calm_s)
            changed_at, before = now, budget


def test_psi_text() -> None:
    """Both lines are read; a file with one line (the slice of an old kernel), an empty one or garbage says less."""
    assert parse_stalls(PSI) == (14.02, 3.5)
    assert parse_stalls("some avg10=0.00 avg60=0 avg300=0 total=0\n") == (0.0, None)
    assert parse_stalls("") == (None, None)
    assert parse_stalls("some avg10=many\n\nfull\n") == (None, None)
    assert parse_available("MemTotal: 1 kB\nMemAvailable:  2048 kB\n") == 2.0
    assert parse_available("MemAvailable: many\n") is None


def test_recorded_files(tmp_path: Path) -> None:
    """The worse of machine and slice counts; of the slice's limit what is left, files that can be dropped included."""
    (tmp_path / "pressure").mkdir()
    (tmp_path / "pressure" / "memory").write_text("some avg10=1.00 total=1\nfull avg10=0.50 total=1\n")
    (tmp_path / "meminfo").write_text("MemTotal: 8000000 kB\nMemAvailable: 4096000 kB\n")
    slice_ = tmp_path / "cgroup" / "user.slice" / "user-7.slice"
    read = reader(tmp_path, tmp_path / "cgroup", uid=7)
    assert read() == Reading(available_mb=4000.0, some=1.0, full=0.5)
    slice_.mkdir(parents=True)
    (slice_ / "memory.pressure").write_text(PSI)
    (slice_ / "memory.max").write_text("max\n")
    (slice_ / "memory.current").write_text(f"{500 * 2**20}\n")
    assert read() == Reading(available_mb=4000.0, some=14.02, full=3.5)
    (slice_ / "memory.max").write_text(f"{600 * 2**20}\n")
    (slice_ / "memory.stat").write_text(f"anon 1\ninactive_file {50 * 2**20}\n")
    assert read().available_mb == 150.0


def test_this_machine() -> None:
    """The kernel that runs this says how much memory is available, and what it says of stalls is a percentage."""
    reading = reader()()
    assert reading.available_mb is not None
    assert reading.available_mb > 1
    for percent in (reading.some, reading.full):
        assert percent is None or 0 <= percent <= 100
    assert "MB available" in reading.text


@pytest.mark.parametrize("text", ["", "\n", "some", "some avg10", "x\x00y=1"])
def test_garbage_is_no_reading(text: str) -> None:
    """A file that says nothing sensible is as good as none."""
    assert parse_stalls(text) == (None, None)
