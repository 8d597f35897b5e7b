"""What comes under one id is heard once, as far as is remembered."""

from appliance.plane.dedup import Deduplicator


def test_an_id_is_new_once() -> None:
    """A second time it is not; without an id everything is new."""
    once = Deduplicator()
    assert [once.new(each) for each in ("a", "b", "a", "", "")] == [True, True, False, True, True]


def test_what_is_remembered_is_bounded() -> None:
    """The ids that came last are known, older ones are forgotten."""
    once = Deduplicator(most=2)
    for each in ("a", "b", "a", "c"):
        once.new(each)
    assert not once.new("a")
    assert once.new("b")
