"""What a vehicle says of itself: estimator, failsafes, words."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.robots.mavlink.dialect import Message, make
from appliance.robots.mavlink.statustext import KEPT, PART, Texts
from appliance.robots.mavlink.vehicle import PREARM_CHECK, Condition, estimator

WELL = 0b11_0011_1111
BATTERY = {
    "id": 0, "battery_function": 1, "type": 1, "temperature": 0, "voltages": [0] * 10, "current_battery": 0,
    "current_consumed": 0, "energy_consumed": 0, "battery_remaining": 5,
}  # fmt: skip


def beat(status: int) -> Message:
    """Make a heartbeat with that system_status."""
    return make("HEARTBEAT", type=2, autopilot=3, base_mode=0, custom_mode=4, system_status=status, mavlink_version=3)


def test_what_an_estimator_does_not_know() -> None:
    """Missing bits are named in words; a relative position stands in unless held constant; glitches are reported."""
    assert estimator(WELL) == ()
    assert estimator(WELL & ~0x10) == ()
    assert estimator(WELL & ~0x10 & ~0x08) == ("no position",)
    assert estimator(WELL | 0x80) == ("no position",)
    assert estimator(WELL | 0x400) == ("GPS glitch",)
    assert "no attitude" in estimator(0)


def test_failsafes_add_up_and_end() -> None:
    """Heartbeat, battery and fence each tell; low is a warning, critical a failsafe; news is published once."""
    condition = Condition()
    assert condition.hear("HEARTBEAT", beat(5))
    assert not condition.hear("HEARTBEAT", beat(5))
    assert condition.failsafe == "failsafe"
    assert condition.hear("BATTERY_STATUS", make("BATTERY_STATUS", **BATTERY, charge_state=2))
    assert condition.warnings == ("battery low",)
    condition.hear("BATTERY_STATUS", make("BATTERY_STATUS", **BATTERY, charge_state=3))
    fence = {"breach_count": 1, "breach_time": 1}
    condition.hear("FENCE_STATUS", make("FENCE_STATUS", breach_status=1, breach_type=3, **fence))
    assert condition.failsafe == "failsafe, battery critical, outside the fence"
    condition.hear("FENCE_STATUS", make("FENCE_STATUS", breach_status=0, breach_type=0, **fence))
    condition.hear("BATTERY_STATUS", make("BATTERY_STATUS", **BATTERY, charge_state=1))
    condition.hear("HEARTBEAT", beat(4))
    assert (condition.failsafe, condition.warnings) == ("", ())


def test_whether_it_would_arm() -> None:
    """The arming check's bit counts only where the autopilot has it."""
    condition = Condition()
    usual = {
        "onboard_control_sensors_present": 0, "load": 0, "voltage_battery": 0, "current_battery": 0,
        "battery_remaining": 0, "drop_rate_comm": 0, "errors_comm": 0, "errors_count1": 0, "errors_count2": 0,
        "errors_count3": 0, "errors_count4": 0,
    }  # fmt: skip
    for enabled, healthy, wanted in ((0, 0, None), (PREARM_CHECK, 0, False), (PREARM_CHECK, PREARM_CHECK, True)):
        condition.hear(
            "SYS_STATUS",
            make(
                "SYS_STATUS",
                **usual,
                onboard_control_sensors_enabled=enabled,
                onboard_control_sensors_health=healthy,
            ),
        )
        assert condition.prearm is wanted


def test_long_texts_are_put_together() -> None:
    """Parts come in any order; one that never comes leaves a mark; what does not explain a refusal is left out."""
    texts = Texts()
    long = "PreArm: " + "x" * 70
    assert texts.take(6, long[PART:], 9, 1, 1.0) is None
    said = texts.take(6, long[:PART], 9, 0, 1.1)
    assert said is not None
    assert said.text == long
    texts.take(4, "y" * PART, 10, 0, 2.0)
    texts.take(4, b"z\0\0", 10, 2, 2.0)
    texts.take(6, "all is well", 0, 0, 2.5)
    assert texts.since(0.0, 10.0) == (long, "y" * PART + "…z")
    assert texts.since(2.6, 10.0) == ()


@given(
    st.lists(
        st.tuples(
            st.integers(0, 7), st.text(max_size=60), st.integers(0, 65535), st.integers(0, 255), st.floats(0, 100)
        ),
        max_size=60,
    )
)
def test_texts_stay_bounded_whatever_comes(parts: list[tuple[int, str, int, int, float]]) -> None:
    """Hostile parts neither raise nor grow what is kept."""
    texts = Texts()
    for severity, text, number, part, now in parts:
        texts.take(severity, text, number, part, now)
    assert len(texts.since(0.0, 1000.0)) <= KEPT
