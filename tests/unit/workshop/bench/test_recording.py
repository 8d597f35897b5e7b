"""The recorder's measurement."""

import pytest

from workshop.bench.recording.run import written

pytestmark = pytest.mark.anyio


async def test_measures_both_writers_and_the_reader() -> None:
    """One run gives a rate for the bare library, the recorder with and without fsync, and the reader."""
    found = await written(messages=300, rounds=1)
    assert found["messages_per_s"].keys() == {"mcap", "recorder_no_fsync", "recorder", "reader"}
    assert all(rate > 0 for rate in found["messages_per_s"].values())
    assert found["file_bytes_per_message"] > 0
