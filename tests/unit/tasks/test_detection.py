"""Which runs are taken for stuck or straggling."""

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.skills.catalogue import SkillManifest
from appliance.tasks.durations import Condition, Known, asked_s, judge, quantile, usual_s
from appliance.tasks.settings import DetectionConfig

CONFIG = DetectionConfig()
QUIET = SkillManifest(id="work", domain="any", summary="works", runs="compute", image="base")
TALKATIVE = replace(QUIET, silent_s=2.0)
seconds = st.floats(0, 10_000, allow_nan=False)
durations = st.lists(seconds, max_size=20)


def test_a_promise_of_the_manifest_counts_alone() -> None:
    """A skill that promises a sign of life every 2 s is stuck after them, however long its runs take."""
    known = Known(learned=[100.0] * 10)
    found = judge(TALKATIVE, running_s=3.0, silent_s=2.1, known=known, asked_s=0.0, config=CONFIG)
    assert found is not None
    assert (found.condition, found.bound_s) == (Condition.STUCK, 2.0)
    assert "its skill promises" in found.note
    assert judge(TALKATIVE, running_s=50.0, silent_s=1.9, known=known, asked_s=0.0, config=CONFIG) is None


def test_without_promise_or_experience_nothing_is_found() -> None:
    """A run of a skill that nobody knows is left to its deadline."""
    known = Known(learned=[1.0] * 4, siblings=[1.0, 1.0])
    assert judge(QUIET, running_s=1e6, silent_s=1e6, known=known, asked_s=0.0, config=CONFIG) is None


def test_siblings_of_the_same_task_are_enough() -> None:
    """Three finished siblings make a straggler of the fourth, as in MapReduce."""
    known = Known(siblings=[4.0, 5.0, 6.0])
    assert judge(QUIET, running_s=11.9, silent_s=0.1, known=known, asked_s=0.0, config=CONFIG) is None
    found = judge(QUIET, running_s=12.1, silent_s=0.1, known=known, asked_s=0.0, config=CONFIG)
    assert found is not None
    assert (found.condition, found.bound_s) == (Condition.STRAGGLING, 12.0)


@given(learned=durations, siblings=durations, running=seconds, silent=seconds, asked=seconds)
def test_no_run_is_judged_before_its_bound_and_each_is_after_it(
    learned: list[float], siblings: list[float], running: float, silent: float, asked: float
) -> None:
    """What is found has passed its bound, the bound is never below the minimum, and more patience finds no more."""
    silent = min(silent, running)
    known = Known(learned=learned, siblings=siblings)
    found = judge(QUIET, running_s=running, silent_s=silent, known=known, asked_s=asked, config=CONFIG)
    usual = usual_s(known, CONFIG)
    if found is None:
        assert usual is None or running <= max(CONFIG.straggler_minimum_s, CONFIG.straggler_factor * max(usual, asked))
        return
    assert usual is not None
    assert found.bound_s >= max(usual, asked)
    if found.condition is Condition.STUCK:
        assert silent > found.bound_s >= CONFIG.stuck_minimum_s
    else:
        assert running > found.bound_s >= CONFIG.straggler_minimum_s
    patient = replace(CONFIG, stuck_factor=1e9, straggler_factor=1e9, stuck_minimum_s=1e9, straggler_minimum_s=1e9)
    assert judge(QUIET, running_s=running, silent_s=silent, known=known, asked_s=asked, config=patient) is None


@given(values=st.lists(seconds, min_size=1), share=st.floats(0.01, 1.0))
def test_a_quantile_is_one_of_the_values_and_enough_are_not_above_it(values: list[float], share: float) -> None:
    """At least the share of values lies at or below it, and no smaller value does that."""
    found = quantile(values, share)
    assert found in values
    assert sum(each <= found for each in values) >= share * len(values) - 1e-9


def test_what_was_asked_for_is_read_with_care() -> None:
    """Only a positive number of seconds within a day counts; parameters come from a language model."""
    assert asked_s({"duration_s": 30}) == 30.0
    for wrong in ({}, {"duration_s": "30"}, {"duration_s": True}, {"duration_s": -1}, {"duration_s": 1e300}):
        assert asked_s(wrong) == 0.0
