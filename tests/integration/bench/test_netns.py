"""Network faults between gateways, each in a network namespace of its own: losses, delays, cuts and what holds.

The namespaces are made without being root, in a user namespace; where the machine forbids that, these tests fail and
say why. Faults are made by a wire of the project's own between the namespaces, frame by frame, since `tc netem` is not
in every kernel. Each run is the benchmark's command, which goes into the namespaces by itself.
"""

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from workshop.bench.net import space

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(420), pytest.mark.long]


@pytest.fixture(scope="module", autouse=True)
def namespaces() -> None:
    """Fail, with the reason, where no namespaces can be made."""
    if reason := space.problem():
        pytest.fail(f"network faults cannot be tested here: {reason}")


async def bench(*arguments: str) -> dict[str, Any]:
    """Run a benchmark and return its result, whether its invariants held or not."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli", "bench", *arguments, "--json",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        out, problems = await process.communicate()
    except BaseException:
        process.terminate()
        await process.wait()
        raise
    print(problems.decode())
    assert process.returncode in (0, 1), problems.decode()
    return json.loads(out)


@pytest.mark.podman
async def test_tasks_are_not_lost_or_doubled_on_a_bad_network(built: None, tmp_path: Path) -> None:
    """Losses, a one-way cut and a partition while tasks run: all succeed, and each effect is there once.

    So it is where both sides of the partition approve, cancel and hand in tasks; then all gateways answer the same.
    """
    result = await bench(
        "chaos", "--gateways", "4", "--tasks", "10", "--faults", "loss,oneway,partition", "--fault-s", "8",
        "--rest-s", "4", "--keep", str(tmp_path / "chaos"),
    )  # fmt: skip
    late = (
        "without the same answers"  # how soon is a figure of the benchmark, and no matter of a loaded machine's tests
    )
    assert [each for each in result["broken"] if late not in each] == [], result
    assert result["tasks"]["states"] == {"succeeded": 10}
    assert [result["effects"][kind] for kind in ("doubled", "lost", "early", "strange")] == [0, 0, 0, 0]
    (cut,) = result["partitions"]["cuts"]
    assert cut["agreed_s"] is not None, result["partitions"]
    assert all(any(each.endswith(" done") for each in side) for side in cut["orders"]), "both sides had orders done"
    assert result["frames"]["cut"] > 0
