"""Rounds in virtual time: how many steps a device makes, how long rounds take; hostile updates."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import RunEvent, RunEventKind
from appliance.skills._lib.learning import shards
from appliance.skills._lib.learning.shards import ModelFileError
from workshop.bench.learning.hostile import Attack, attackers, spoiled
from workshop.bench.learning.live import Heard, exceeded, nominal_batch_s
from workshop.bench.learning.virtual import decide, steps_by, steps_of


@given(st.floats(0.001, 1000), st.floats(0.001, 100), st.integers(1, 1000))
def test_a_device_makes_the_steps_that_it_begins_in_time(stop_at_s: float, batch_s: float, whole: int) -> None:
    """At least one and at most an epoch; the last one begins before the end of the time."""
    done = steps_by(stop_at_s, batch_s, whole)
    assert 1 <= done <= whole
    if done > 1:
        assert (done - 1) * batch_s < stop_at_s * (1 + 1e-6)
    if done < whole:
        assert done * batch_s >= stop_at_s * (1 - 1e-6)


def test_stragglers_hold_up_fedavg_alone() -> None:
    """FedAvg's rounds last as long as the slowest device's epoch; with the deadline or help they are far shorter."""
    held = [96] * 16
    took = {
        mode: decide("clips", mode, clients=16, count=20, held=held, stragglers=True)["p50_s"]
        for mode in ("sync", "partial", "offload", "buffered")
    }
    assert took["sync"] == pytest.approx(5 * steps_of(96, 16) * 0.25)
    assert took["partial"] == pytest.approx(1.3 * steps_of(96, 16) * 0.25)
    assert took["buffered"] == pytest.approx(steps_of(96, 16) * 0.25)
    assert took["offload"] < 0.4 * took["sync"]
    even = decide("clips", "partial", clients=16, count=20, held=held, stragglers=False)
    assert even["p50_s"] == pytest.approx(steps_of(96, 16) * 0.25)


def test_rounds_of_a_mode_that_drops_count_no_late_update() -> None:
    """Of `drop` slow clients never count; of `buffered` they do, late."""
    held = [96] * 16
    dropping = decide("clips", "drop", clients=16, count=20, held=held, stragglers=True)
    buffered = decide("clips", "buffered", clients=16, count=20, held=held, stragglers=True)
    assert (dropping["late"], "part-000" in dropping["counted"]) == (0, False)
    assert buffered["late"] > 0
    assert buffered["counted"]["part-000"] > 0


@pytest.mark.parametrize("attack", ["flip", "nan", "noise", "hidden"])
def test_hostile_updates_are_whole_files(attack: Attack) -> None:
    """They fit their manifests, so that only their values tell them: one has NaN, the others another direction."""
    values = {"a": np.arange(6, dtype=np.float32).reshape(2, 3) + 1, "b": np.ones(4, dtype=np.float32)}
    files: dict[str, bytes] = {}
    parts = list(shards.split(values))
    manifest = shards.collect(parts, norm=1.0)
    references = [{"artifact": each.digest, "bytes": each.bytes, "name": "x"} for each in manifest.shards]
    files |= {each.digest: data for each, (_, data) in zip(manifest.shards, parts, strict=True)}
    told = {"manifest": manifest.to_json(), "shards": references}
    found = spoiled(told, attack, files, seed=3)
    sent = shards.parse_manifest(found["manifest"])
    data = (files[each["artifact"]] for each in found["shards"])
    if attack == "nan":
        with pytest.raises(ModelFileError, match="NaN"):
            shards.join(sent, data)
        return
    got = shards.join(sent, data)
    factor = {"flip": -10.0, "hidden": -2.0}.get(attack)
    if factor is not None:
        assert all(np.allclose(got[name], values[name] * factor) for name in values)
    else:
        norms = [math.sqrt(sum(float((each**2).sum()) for each in one.values())) for one in (got, values)]
        assert norms[0] == pytest.approx(10 * norms[1], rel=1e-4)
    assert spoiled(told, attack, files, seed=3) == found


def test_a_quarter_attacks() -> None:
    """The last quarter, with all kinds of attacks; the slow ones are others."""
    assert list(attackers("mixed", 16)) == ["part-012", "part-013", "part-014", "part-015"]
    assert set(attackers("mixed", 16).values()) == {"flip", "nan", "noise"}
    assert set(attackers("hidden", 8).values()) == {"hidden"}
    assert attackers("none", 16) == {}


def test_emulation_that_does_not_hold_is_seen() -> None:
    """A nominal client's run that took 10 % longer is counted; slow clients and helpers' parts are left out."""

    def heard(subtask: str, train_s: float) -> Heard:
        event = RunEvent(
            task="r.1", subtask=subtask, attempt=1, kind=RunEventKind.SUCCEEDED, result={"train_s": train_s, "steps": 4}
        )
        return Heard(1, subtask, 1, 0.0, 1.0, 1.0, event)

    slow = {"part-000": 5.0}
    runs = [heard("part-000", 20.0), heard("part-001", 4.1), heard("part-002", 4.5), heard("part-000.1", 9.0)]
    assert exceeded(runs, slow, 1.0) == (1, 2)
    assert nominal_batch_s(0.014, 16) > 0.014 * 16 / 64
