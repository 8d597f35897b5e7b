"""Moments and durations as people write them."""

import contextlib
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError
from appliance.times import duration_s, moment_ns, since_ns

ZURICH = ZoneInfo("Europe/Zurich")
NOW = datetime(2026, 11, 27, 18, 0, tzinfo=ZURICH)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90", 90), ("90s", 90), ("5m", 300), ("1h30m", 5400), ("2D", 172_800), ("1w", 604_800), ("0.5h", 1800),
     ("", None), ("m", None), ("-5m", None), ("5 min", None), ("1e9", None), ("9" * 30, None)],
)  # fmt: skip
def test_durations(text: str, seconds: float | None) -> None:
    """Units may be put together; what is no duration is none."""
    assert duration_s(text) == seconds


@pytest.mark.parametrize(
    ("text", "ahead", "expected"),
    [
        ("2026-11-27", False, "2026-11-27T00:00:00+01:00"), ("07:30", False, "2026-11-27T07:30:00+01:00"),
        ("7:30", True, "2026-11-28T07:30:00+01:00"), ("19:00", True, "2026-11-27T19:00:00+01:00"),
        ("2026-07-01T07:30", False, "2026-07-01T07:30:00+02:00"),
        ("2026-07-01T07:30+00:00", False, "2026-07-01T07:30:00+00:00"),
    ],
)  # fmt: skip
def test_moments(text: str, ahead: bool, expected: str) -> None:
    """In the zone that is given, unless they have an offset; a time of day to come is tomorrow's when it is over."""
    assert (
        moment_ns(text, now=NOW, option="--at", ahead=ahead)
        == int(datetime.fromisoformat(expected).timestamp()) * 10**9
    )


@pytest.mark.parametrize("text", ["", "noon", "25:00", "2026-13-01", "2026-03-29T02:30", "99999-01-01"])
def test_what_is_no_moment_is_refused(text: str) -> None:
    """Also a time that no clock shows, since clocks are put forward over it; the error names option and remedy."""
    with pytest.raises(ConfigError, match="--at") as refused:
        moment_ns(text, now=NOW, option="--at")
    assert refused.value.remedy


@given(st.text(max_size=30))
def test_no_text_breaks_it(text: str) -> None:
    """Whatever is typed is a moment, or refused."""
    with contextlib.suppress(ConfigError):
        assert isinstance(since_ns(text, now=NOW.astimezone(UTC)), int)
