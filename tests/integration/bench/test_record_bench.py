"""From put to file and through kills, with processes of their own, as `swiftbot bench record` measures it."""

import pytest

from workshop.bench.recording.run import LAST_S, kill, run

STARVED_S = 2.0
"""How long a machine that does many other things may keep the recorder from its turn; the benchmark allows none."""

pytestmark = pytest.mark.anyio


async def test_every_message_is_in_the_file_or_counted() -> None:
    """What another process puts as fast as it can is all there, once, or the log says how much is not."""
    found = await run(messages=0, rounds=1, flow=20_000)
    for each in found["flow"]["rounds"]["recorder"]:
        assert each["unaccounted"] == 0
        assert each["doubled"] == 0
    assert found["flow"]["messages_per_s"].keys() == {"recorder", "bare"}


async def test_a_kill_takes_at_most_the_last_second() -> None:
    """Killed at five random moments: whatever is recovered has no hole and no damage, and all but the last second."""
    for after_s in (0.6, 0.83, 1.07, 1.31, 1.58):
        found = await kill(after_s, per_s=500.0)
        assert (found["holes"], found["problems"]) == (0, [])
        assert found["lost_s"] <= LAST_S + STARVED_S
        assert found["messages"]
