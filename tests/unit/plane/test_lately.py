"""What became of the writes that were ordered last, by their ids."""

from appliance.plane.lately import Lately


def test_a_write_is_under_way_and_then_done() -> None:
    """It is known from its order on, with its version once it is acknowledged; one that failed is not."""
    lately = Lately()
    assert lately.of("k", "w") == (False, None)
    lately.began("k", "w")
    assert lately.of("k", "w") == (True, None)
    lately.ended("k", "w", {"a": 1})
    assert lately.of("k", "w") == (True, {"a": 1})
    assert lately.of("other", "w") == (False, None)
    lately.failed("k", "w")
    assert lately.of("k", "w") == (False, None)


def test_only_the_last_are_known() -> None:
    """Of more than are kept the oldest are forgotten; writes without an id are nobody's."""
    lately = Lately(most=2)
    for number in range(4):
        lately.began("k", f"w{number}")
    assert [lately.of("k", f"w{number}")[0] for number in range(4)] == [False, False, True, True]
    lately.ended("k", "", {"a": 1})
    assert lately.of("k", "") == (False, None)
    lately.ended("k", "w2", {"a": 3})
    lately.began("k", "w4")
    assert lately.of("k", "w2") == (True, {"a": 3})
    assert lately.of("k", "w3") == (False, None)
