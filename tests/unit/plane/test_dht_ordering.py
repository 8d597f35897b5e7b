"""Writes that are asked for again: what their owner remembers of them."""

from appliance.plane.dht import Acknowledged


def test_a_write_is_known_by_its_key_and_id() -> None:
    """Under way, then acknowledged with its version; one that failed, or has no id, is looked at again."""
    known = Acknowledged()
    assert known.of("k", "w") == (False, None)
    known.note("k", "w", None)
    assert known.of("k", "w") == (True, None)
    known.note("k", "w", {"g1": 1})
    assert known.of("k", "w") == (True, {"g1": 1})
    assert known.of("other", "w") == (False, None)
    known.failed("k", "w")
    known.note("k", "", {"g1": 2})
    assert known.of("k", "w") == known.of("k", "") == (False, None)


def test_what_is_remembered_has_a_limit() -> None:
    """The oldest are forgotten, those that were heard of again are not."""
    known = Acknowledged(most=2)
    known.note("k", "1", None)
    known.note("k", "2", None)
    known.note("k", "1", {"g1": 1})
    known.note("k", "3", None)
    assert [known.of("k", each)[0] for each in ("1", "2", "3")] == [True, False, True]
