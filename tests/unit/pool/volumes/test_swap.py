"""Swapping a volume's state: whenever it is interrupted, going on ends with the new state whole and the old kept."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.pool.volumes.store import Place

NAMES = st.sets(st.sampled_from(["a", "b", "c", "d", "e"]))


@given(old=NAMES, new=NAMES, done=st.integers(0, 12))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_interruption_is_gone_on_from(
    old: set[str], new: set[str], done: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """After any number of renames, the journal leads to the whole new state, with the old one beside it."""
    base = tmp_path_factory.mktemp("swap")
    root = base / "_data"
    root.mkdir()
    for name in old:
        (root / name).mkdir()
        (root / name / "old").touch()
    place = Place(root)
    incoming = place.prepare()
    for name in new:
        (incoming / name).mkdir()
        (incoming / name / "new").touch()
    assert place.journal() is None
    steps = place.steps(place.begin({"g": 1}, "g"))
    for _, (source, target) in zip(range(done), steps, strict=False):
        source.rename(target)

    found = Place(root)
    journal = found.journal()
    assert journal is not None
    found.finish(journal)
    assert {each.name: [inner.name for inner in each.iterdir()] for each in root.iterdir()} == {
        name: ["new"] for name in new
    }
    assert {each.name: [inner.name for inner in each.iterdir()] for each in found.outgoing.iterdir()} == {
        name: ["old"] for name in old
    }
    found.finish(journal)
    found.forget()
    assert sorted(each.name for each in base.iterdir()) == ["_data"]
    assert found.journal() is None


def test_nothing_begun_is_nothing_to_finish(tmp_path: Path) -> None:
    """What was unpacked without a journal, or with half a journal, does not count; the next try clears it away."""
    root = tmp_path / "_data"
    root.mkdir()
    (root / "kept").touch()
    place = Place(root)
    (place.prepare() / "half").touch()
    (place.work / "journal").write_bytes(b'{"old": [')
    assert place.journal() is None
    assert list(Place(root).prepare().iterdir()) == []
    assert [each.name for each in root.iterdir()] == ["kept"]
