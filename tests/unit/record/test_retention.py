"""How much disk logs may take."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import NotFoundError
from appliance.record.retention import Kept, make_room, pin, pin_of, surplus

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
    gone = surplus(kept, budget_bytes=budget)
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
    assert make_room(tmp_path, "f1-a-", budget_bytes=200) == 1
    assert set(tmp_path.iterdir()) == {mine[0], pin_of(mine[0]), mine[2], *others}
    pin(mine[0], pinned=False)
    assert make_room(tmp_path, "f1-a-", budget_bytes=0) == 2
    assert set(tmp_path.iterdir()) == set(others)
    with pytest.raises(NotFoundError):
        pin(mine[0], pinned=True)
