"""Key expressions against keys."""

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.record.expressions import matches

_CHUNK = st.sampled_from(["a", "b", "ab"])
_KEY = st.lists(_CHUNK, min_size=1, max_size=5).map("/".join)
_EXPRESSION = st.lists(st.sampled_from(["a", "b", "ab", "*", "**", "a$*"]), min_size=1, max_size=5).map("/".join)


@settings(deadline=None)
@given(expression=_EXPRESSION, key=_KEY)
def test_agrees_with_zenoh(expression: str, key: str) -> None:
    """The matcher says of every expression and key what Zenoh itself says."""
    assert matches(expression, key) == zenoh.KeyExpr.autocanonize(expression).includes(zenoh.KeyExpr(key))


@pytest.mark.parametrize("key", ["swiftbot/f1", "swiftbot/f1/gw/a/status", "swiftbot/f1/x"])
def test_everything_of_a_fleet(key: str) -> None:
    """`**` at the end stands for any number of chunks, none too."""
    assert matches("swiftbot/f1/**", key)
    assert not matches("swiftbot/f2/**", key)
