"""The steps of rounds in a log: made again they are the same, and what was changed is found."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from msgspec.structs import replace

from appliance.learn import rounds
from appliance.learn.decisions import Again, RoundCase, TracedDecider, all_traced
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.model.learning import Clients, Data, Mode, PartialUpdate, Recipe, Rounds
from appliance.tasks.replay import CheckReport, check
from workshop.simulators.learning import Device, Faults, Simulation

KEY = Keys("f")(keyspace.DECIDED, "gw-1", "round")
some = st.floats(0.0, 0.3)


def simulated(mode: Mode = Mode.PARTIAL, *, wrong: Faults | None = None, seeded: int = 1) -> list[RoundCase]:
    """Return the steps of all rounds of a simulated run of six clients, two of them five times slower."""
    told: list[RoundCase] = []
    share = "fleet" if mode is Mode.OFFLOAD else "never"
    recipe = Recipe(
        model="clips", data=Data(share=share), clients=Clients(partitions=6), rounds=Rounds(count=4, mode=mode)
    )
    devices = {name: Device(5.0 if number < 2 else 1.0) for number, name in enumerate(recipe.names)}
    traced = partial(TracedDecider, put=told.append)
    Simulation(recipe, devices, faults=wrong, seed_number=seeded, decider=traced).play()
    return told


def checked(folder: Path, told: Sequence[msgspec.Struct | dict[str, Any]]) -> CheckReport:
    """Write steps into a log, and make them again."""
    path = folder / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(KEY, "json", 0)
        for at, case in enumerate(told, start=1):
            writer.add_message(channel, at, msgspec.json.encode(case), at)
        writer.finish()
    return check([path], traced=all_traced())


@given(
    st.sampled_from([Mode.SYNC, Mode.BUFFERED, Mode.PARTIAL, Mode.OFFLOAD]),
    st.builds(Faults, fails=some, leaves=some, repeated=some, foreign=some, takeover=some, refused=some,
              aggregation=some), st.integers(0, 2**20),
)  # fmt: skip
@settings(deadline=None, max_examples=40)
def test_every_step_of_any_run_is_made_again_from_its_json(mode: Mode, wrong: Faults, seeded: int) -> None:
    """With faults and takeovers in each mode, decoded steps give the same instructions and the same reasons to wait."""
    again = Again()
    told = simulated(mode, wrong=wrong, seeded=seeded)
    assert any(case.event is not None for case in told)
    for case in told:
        read = msgspec.json.decode(msgspec.json.encode(case), type=RoundCase)
        assert again.decide(read) == {"decided": case.decided, "waits": case.waits}


def test_a_log_of_a_run_is_checked_step_by_step(tmp_path: Path) -> None:
    """All steps are made again, and none differs."""
    told = simulated()
    report = checked(tmp_path, told)
    assert report.checked == {"round": len(told)}
    assert report.same
    assert not report.unchecked


def test_a_decision_that_was_changed_is_the_first_difference(tmp_path: Path) -> None:
    """A log that says another client was ordered: shown with run, round and step, as logged and as decided now."""
    told = simulated()
    number = next(number for number, case in enumerate(told) if any("send" in each for each in case.decided))
    wrong = tuple(each.replace("part-003", "part-005") for each in told[number].decided)
    told[number] = replace(told[number], decided=wrong)
    report = checked(tmp_path, told)
    assert report.diverged == 1
    first = report.divergences[0]
    case = told[number]
    assert first.decider == "round"
    assert first.what == f"step {case.step} of round {case.round} of run simulated ({case.coordinator})"
    assert "send part-003" in first.now
    assert "send part-003" not in first.logged


def test_an_event_that_was_changed_shows_in_what_follows_from_it(tmp_path: Path) -> None:
    """An update that is said to be of more samples: its acceptance is another one."""
    told = simulated()
    number, event = next(
        (number, case.event) for number, case in enumerate(told) if isinstance(case.event, rounds.Arrived)
    )
    more = replace(event.update, samples=event.update.samples + 1)
    told[number] = replace(told[number], event=rounds.Arrived(event.run, more))
    report = checked(tmp_path, told)
    assert not report.same
    assert report.divergences[0].what.startswith(f"step {told[number].step} of round {told[number].round}")


def test_what_follows_a_step_that_is_not_in_the_log_is_counted_and_no_difference(tmp_path: Path) -> None:
    """A recorder that missed a step: the rest of that round is not checked, the next round is."""
    told = simulated()
    second = next(number for number, case in enumerate(told) if case.step == 2)
    missed = [case for number, case in enumerate(told) if number != second]
    report = checked(tmp_path, missed)
    lost = sum(case.coordinator == told[second].coordinator for case in told) - 3
    assert report.same
    assert report.unchecked == {"after what is not in the log": lost}
    assert report.checked == {"round": len(missed) - lost}


def test_a_step_that_is_in_the_log_twice_is_made_again_once(tmp_path: Path) -> None:
    """A message that was put again after a gap: the steps behind it are still followed."""
    told = simulated()
    report = checked(tmp_path, [*told[:2], told[1], *told[2:]])
    assert report.same
    assert report.checked == {"round": len(told)}


@pytest.mark.parametrize("event", [{"type": "Lost", "client": 7}, {"type": "Nothing"}, []])
def test_a_step_that_is_none_is_counted_as_malformed(tmp_path: Path, event: object) -> None:
    """Steps of another form break nothing, and are no difference."""
    told = simulated()
    wrong = msgspec.to_builtins(told[1]) | {"event": event}
    report = checked(tmp_path, [told[0], wrong])
    assert report.unchecked == {"malformed": 1}
    assert report.same


def test_an_event_that_breaks_the_decider_is_a_difference(tmp_path: Path) -> None:
    """What a log says could not have been handled so: it is shown, and reading goes on."""
    told = simulated()
    begin = told[0].begin
    assert begin is not None
    wrong = replace(told[0], begin=replace(begin, run=replace(begin.run, clients=())), step=0)
    strange = replace(told[1], event=rounds.Arrived("simulated", PartialUpdate(client="part-000", round=1)))
    report = checked(tmp_path, [wrong, strange, *simulated(seeded=2)])
    assert not report.same
    assert report.checked["round"] > 2


def test_of_references_to_files_steps_have_the_sizes_alone() -> None:
    """They are counted; nothing is decided by anything else of them, and a log has digests of models at most."""
    update = PartialUpdate(client="c", round=1, manifest={"tensors": []}, shards=({"artifact": "x", "bytes": 7},))
    told: list[RoundCase] = []
    first = simulated()[0].begin
    assert first is not None
    decider = TracedDecider(first.run, first.record, present=first.present, now=0.0, put=told.append)
    decider.resume(0.0)
    decider.handle(rounds.Arrived("simulated", update), 1.0)
    assert isinstance(told[1].event, rounds.Arrived)
    assert told[1].event.update.shards == ({"bytes": 7},)
    assert told[1].event.update.manifest == {}
