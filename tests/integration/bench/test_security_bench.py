"""What keys cost: the benchmark that compares a fleet with them and one without."""

import pytest

from workshop.bench import security

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]


async def test_the_benchmark_measures_both_sides(built: None) -> None:
    """Each kind with keys and without, as often as asked, by gateways of its own."""
    found = await security.run(25, 2, image="base", progress=print)
    assert {kind: [found[kind][side]["count"] for side in security.SIDES] for kind in found} == {
        "put": [25, 25],
        "get": [25, 25],
        "round_trip": [25, 25],
        "elsewhere": [2, 2],
    }
    assert all(each["ratio"] > 0 for each in found.values())
