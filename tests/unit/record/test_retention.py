"""How much disk logs may take."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import NotFoundError
from appliance.record.retention import (
    MOST_BY_AGE,
    Budget,
    Kept,
    going_text,
    make_room,
    next_to_go,
    pin,
    pin_of,
    surplus,
)

files = st.lists(
    st.builds(
        Kept,
        path=st.uuids().map(lambda each: Path(f"{each}.mcap")),
        size_bytes=st.integers(0, 100),
        modified_ns=st.integers(0, 20),
        pinned=st.booleans(),
    ),
    max_size=12,
)


@given(files, st.integers(0, 600))
def test_the_oldest_go_and_no_more_than_needed(kept: list[Kept], budget: int) -> None:
    """What is left is within the budget unless only pinned files are left; the last one removed was needed."""
    gone = surplus(kept, Budget(most_bytes=budget), now_ns=0)
    left = [each for each in kept if each not in gone]
    total = sum(each.size_bytes for each in left)
    assert not any(each.pinned for each in gone)
    assert total <= budget or all(each.pinned for each in left)
    if gone:
        assert total + gone[-1].size_bytes > budget
        newest = max(each.modified_ns for each in gone)
        assert all(each.pinned or each.modified_ns >= newest for each in left)


def test_only_this_recorders_files_go(tmp_path: Path) -> None:
    """Files of other recorders, pinned files and other files stay; a pin can be taken back."""
    mine = [tmp_path / f"f1-a-20261121T10000{number}Z-0001.mcap" for number in range(3)]
    others = [tmp_path / name for name in ("f1-a-b-20261121T100000Z-0001.mcap", "f1-a-mine.mcap", "f1-a-notes.txt")]
    for age, path in enumerate([*reversed(mine), *others]):
        path.write_bytes(bytes(100))
        os.utime(path, (1000 - age, 1000 - age))
    pin(mine[0], pinned=True)
    assert make_room(tmp_path, "f1-a-", Budget(most_bytes=200), now_ns=0) == 1
    assert set(tmp_path.iterdir()) == {mine[0], pin_of(mine[0]), mine[2], *others}
    pin(mine[0], pinned=False)
    assert make_room(tmp_path, "f1-a-", Budget(most_bytes=0), now_ns=0) == 2
    assert set(tmp_path.iterdir()) == set(others)
    with pytest.raises(NotFoundError):
        pin(mine[0], pinned=True)


@given(files, st.integers(0, 30), st.floats(0, 1e-8))
def test_old_files_go_a_few_at_a_time(kept: list[Kept], now_ns: int, most_s: float) -> None:
    """Only those that are too old, the oldest first, never a pinned one; a clock far ahead takes no more at once."""
    gone = surplus(kept, Budget(most_s=most_s), now_ns=now_ns)
    assert len(gone) <= MOST_BY_AGE
    assert all(not each.pinned and now_ns - each.modified_ns > most_s * 1e9 for each in gone)
    assert surplus(kept, Budget(), now_ns=10**19) == ()


HOUR_NS = 3_600 * 10**9


def hourly(count: int, *, pinned: int = 0) -> list[Kept]:
    """Return a file of 100 bytes for each hour, the first ones pinned."""
    return [
        Kept(path=Path(f"{hour}.mcap"), size_bytes=100, modified_ns=hour * HOUR_NS, pinned=hour < pinned)
        for hour in range(count)
    ]


def test_what_goes_next_is_known_before() -> None:
    """By the rate of what is there, or by age, whichever is sooner; pinned files do not go."""
    found = next_to_go(hourly(10), Budget(most_bytes=1_500), now_ns=9 * HOUR_NS)
    assert found is not None
    assert (found[0].path.name, round(found[1] / 3600, 1)) == ("0.mcap", 5.0)  # 900 bytes in nine hours, 500 left
    found = next_to_go(hourly(10, pinned=2), Budget(most_bytes=1_500, most_s=4 * 3600.0), now_ns=9 * HOUR_NS)
    assert found is not None
    assert (found[0].path.name, found[1]) == ("2.mcap", 0.0)
    for files in ([], hourly(2, pinned=2), hourly(1)):
        assert next_to_go(files, Budget(most_bytes=1_500), now_ns=9 * HOUR_NS) is None
    assert next_to_go(hourly(10), Budget(), now_ns=9 * HOUR_NS) is None


def test_people_are_told_before_logs_go() -> None:
    """Within the time that is configured, with the day up to which; with 0 never."""
    budget = Budget(most_bytes=1_500)
    told = going_text(hourly(10), budget, now_ns=9 * HOUR_NS, warn_s=6 * 3600.0)
    assert told == "logs up to 1970-01-01 00:00 UTC are removed within 6 h"
    assert going_text(hourly(10), budget, now_ns=9 * HOUR_NS, warn_s=4 * 3600.0) == ""
    assert going_text(hourly(20), budget, now_ns=19 * HOUR_NS, warn_s=0.0) == ""
