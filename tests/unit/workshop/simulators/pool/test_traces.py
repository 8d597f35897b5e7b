"""Arrival traces: they have the shape they claim, repeat by their seed, and recorded ones come back as they were."""

from itertools import pairwise
from pathlib import Path
from statistics import mean, pstdev

import pytest

from appliance.errors import ConfigError
from workshop.simulators.pool.traces import KINDS, Trace, azure, plain, read_trace, write_trace


def variation(trace: Trace, image: str) -> float:
    """Coefficient of variation of the gaps between an image's arrivals."""
    times = [each.at_s for each in trace.arrivals if each.image == image]
    gaps = [after - before for before, after in pairwise(times)]
    return pstdev(gaps) / mean(gaps)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_rates_and_order(kind: str) -> None:
    """Arrivals come in order, within the time, about as many as asked for; the same seed gives the same ones."""
    trace = plain(kind, rate=0.5, duration_s=86_400.0, images=6)
    times = [each.at_s for each in trace.arrivals]
    assert times == sorted(times)
    assert 0 <= times[0] <= times[-1] <= trace.duration_s + 60.0
    assert len(times) == pytest.approx(43_200, rel=0.15)
    assert trace == plain(kind, rate=0.5, duration_s=86_400.0, images=6)
    assert trace != plain(kind, rate=0.5, duration_s=86_400.0, images=6, seed=2)


def test_gaps_vary_as_they_should() -> None:
    """Not at all for timers, as much as the mean for Poisson, more in bursts."""
    of = {kind: variation(plain(kind, rate=0.5, duration_s=20_000.0, images=1), "image-000") for kind in KINDS}
    assert of["timer"] < 0.05
    assert of["poisson"] == pytest.approx(1.0, abs=0.1)
    assert of["bursts"] > 1.5


def test_the_shape_of_azure() -> None:
    """A few functions have most of the runs, many have hardly any, memory is spread; work is spread over gateways."""
    trace = azure(gateways=4)
    counts = sorted((sum(each.image == image for each in trace.arrivals) for image in trace.images), reverse=True)
    assert sum(counts[:10]) > 0.6 * sum(counts)
    assert sum(count <= 2 for count in counts) > 0.4 * len(counts)
    assert {each.gateway for each in trace.arrivals} == {0, 1, 2, 3}
    sizes = sorted(image.memory_mb for image in trace.images.values())
    assert sizes[-1] > 4 * sizes[0]


def test_a_recorded_trace_comes_back(tmp_path: Path) -> None:
    """What was written is read again, from its first arrival on."""
    trace = plain("poisson", rate=0.1, duration_s=1000.0, images=3, gateways=2)
    path = tmp_path / "fleet.jsonl"
    write_trace(trace, path)
    again = read_trace(path, trace.images)
    first = trace.arrivals[0].at_s
    assert again.name == "fleet"
    assert again.gateways == 2
    assert [each.at_s for each in again.arrivals] == [each.at_s - first for each in trace.arrivals]
    assert [each.image for each in again.arrivals] == [each.image for each in trace.arrivals]


@pytest.mark.parametrize("line", ["", "{", '{"at_s": 1}', '{"at_s": -1, "image": "a", "service_s": 1}', "[]"])
def test_what_is_no_trace_is_refused(tmp_path: Path, line: str) -> None:
    """A damaged line is reported with its number."""
    path = tmp_path / "bad.jsonl"
    path.write_text(line + "\n")
    with pytest.raises(ConfigError, match=r"line 1|no arrivals"):
        read_trace(path)
