"""Key expressions against keys."""

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import ConfigError
from appliance.record.models import check_expression, matches

_CHUNK = st.sampled_from(["a", "b", "ab"])
_KEY = st.lists(_CHUNK, min_size=1, max_size=5).map("/".join)
_EXPRESSION = st.lists(st.sampled_from(["a", "b", "ab", "*", "**", "a$*"]), min_size=1, max_size=5).map("/".join)


@settings(deadline=None)
@given(expression=_EXPRESSION, key=_KEY)
def test_agrees_with_zenoh(expression: str, key: str) -> None:
    """The matcher says of every expression and key what Zenoh itself says."""
    assert matches(expression, key) == zenoh.KeyExpr.autocanonize(expression).includes(zenoh.KeyExpr(key))


@pytest.mark.parametrize(
    "expression", ["**", "a/*/b", "a/$*b/**", "swiftbot/f1/task/t-1/record", "/robot_1/odom", "a$*"]
)
def test_what_is_an_expression(expression: str) -> None:
    """It is taken as it is; topics of other writers, too."""
    assert check_expression(expression) == expression


@pytest.mark.parametrize("expression", ["", "*task", "**transition", "a/b*", "a/***", "a/$b", "a?b", "gw-*/log"])
def test_what_is_none(expression: str) -> None:
    """What a shell would take and Zenoh does not is refused with what is meant, instead of matching nothing."""
    with pytest.raises(ConfigError, match="is no key expression") as told:
        check_expression(expression)
    assert "`**`" in told.value.remedy


@pytest.mark.parametrize("key", ["swiftbot/f1", "swiftbot/f1/gw/a/status", "swiftbot/f1/x"])
def test_everything_of_a_fleet(key: str) -> None:
    """`**` at the end stands for any number of chunks, none too."""
    assert matches("swiftbot/f1/**", key)
    assert not matches("swiftbot/f2/**", key)
