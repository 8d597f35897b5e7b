"""Who has a vehicle: the gateway, a pilot, a failsafe."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.robots.mavlink.dialect import make
from appliance.robots.mavlink.vehicle import CHANGE_S, COPTER, ROVER, STICKS_S, Control, modes_of, moved

AUTO, GUIDED, LOITER, RTL, LAND, BRAKE, STABILIZE = (
    COPTER.numbers[name] for name in ("AUTO", "GUIDED", "LOITER", "RTL", "LAND", "BRAKE", "STABILIZE")
)


def flying(mode: int = AUTO) -> Control:
    """A vehicle in the air in a mode that the gateway ordered."""
    control = Control()
    control.order(mode, 0.0)
    assert not control.hear(mode, True, "", COPTER, 1.0)
    return control


def test_a_mode_that_the_gateway_did_not_order_is_a_takeover() -> None:
    """A pilot's LOITER seizes it, with both modes in the reason; AUTO again gives it back."""
    control = flying()
    assert control.hear(LOITER, True, "", COPTER, 2.0)
    assert control.seized is not None
    assert (control.seized.by, control.seized.why) == (
        "pilot",
        "its mode was changed from AUTO to LOITER, not by this gateway",
    )
    assert not control.hear(LOITER, True, "", COPTER, 3.0)
    assert control.hear(AUTO, True, "", COPTER, 4.0)
    assert control.seized is None


def test_the_guided_mode_and_disarming_give_it_back() -> None:
    """GUIDED is the mode in which a pilot hands over; on the ground with the motors off nobody has it."""
    for mode, armed in ((GUIDED, True), (LOITER, False)):
        control = flying()
        control.hear(LOITER, True, "", COPTER, 2.0)
        control.hear(mode, armed, "", COPTER, 3.0)
        assert control.seized is None


def test_a_change_that_was_ordered_or_follows_by_itself_is_none() -> None:
    """The old mode while a new one is ordered, and LAND after RTL, are no takeover, however late that is."""
    control = flying()
    control.order(GUIDED, 2.0)
    control.hear(AUTO, True, "", COPTER, 3.0)
    control.hear(GUIDED, True, "", COPTER, 4.0)
    assert control.seized is None
    control = flying(RTL)
    control.hear(LAND, True, "", COPTER, 2.0)
    assert control.seized is None
    control = flying(GUIDED)
    control.order(AUTO, 2.0)
    control.hear(GUIDED, True, "", COPTER, 2.0 + CHANGE_S + 1.0)
    assert control.seized is None
    control = flying(RTL)
    control.order(AUTO, 2.0)
    control.hear(LAND, True, "", COPTER, 3.0)
    assert control.seized is None


@pytest.mark.parametrize("name", ["LOITER", "RTL", "LAND", "BRAKE"])
def test_a_pilot_is_seen_while_a_change_is_in_flight(name: str) -> None:
    """A mode that is neither the one before nor an ordered one is a takeover, at once and when the change is late."""
    for now in (2.5, 2.0 + CHANGE_S + 1.0):
        control = flying(AUTO)
        control.order(GUIDED, 1.5)
        control.hear(GUIDED, True, "", COPTER, 1.8)
        control.order(AUTO, 2.0)
        control.hear(GUIDED, True, "", COPTER, 2.2)
        control.hear(COPTER.numbers[name], True, "", COPTER, now)
        assert control.seized is not None
        assert control.seized.why == f"its mode was changed from AUTO to {name}, not by this gateway"
        control.hear(AUTO, True, "", COPTER, now + 1.0)
        assert control.seized is None


@given(
    st.sampled_from(sorted(COPTER.numbers)),
    st.sampled_from(sorted(COPTER.numbers)),
    st.sampled_from(sorted(COPTER.numbers)),
)
def test_what_is_heard_during_a_change_is_expected_or_a_takeover(own: str, wanted: str, heard: str) -> None:
    """Whatever the three modes are: the one before, the ordered one, what follows these by itself, or the guided."""
    control = flying(COPTER.numbers[own])
    control.order(COPTER.numbers[wanted], 2.0)
    control.hear(COPTER.numbers[heard], True, "", COPTER, 2.5)
    expected = {own, wanted, *COPTER.follows.get(own, ()), *COPTER.follows.get(wanted, ())}
    if own != wanted:
        expected.add("GUIDED")  # it is given into the gateway's hands by that one
    assert (control.seized is None) == (heard in expected)


def test_a_pilot_is_seen_by_a_gateway_that_has_just_started() -> None:
    """Nothing was ordered yet: armed in a mode flown by hand it is a pilot's, in another nobody can tell."""
    control = Control()
    assert control.hear(LOITER, True, "", COPTER, 1.0)
    assert control.seized is not None
    assert (control.seized.by, control.seized.why) == (
        "pilot",
        "it is armed in LOITER, where sticks move it, and this gateway did not choose that",
    )
    control.hear(AUTO, True, "", COPTER, 2.0)
    assert control.seized is not None  # whose mission that is it cannot know
    control.hear(GUIDED, True, "", COPTER, 3.0)
    assert control.seized is None
    control.hear(AUTO, True, "", COPTER, 4.0)  # a ground station flies it; nothing was taken from the gateway
    assert control.seized is None
    for mode in (AUTO, GUIDED, RTL):
        control = Control()
        control.hear(mode, True, "", COPTER, 1.0)
        assert control.seized is None
        control.hear(LOITER, True, "", COPTER, 2.0)
        assert control.seized is not None


@pytest.mark.parametrize("name", ["AUTOTUNE", "ZIGZAG", "FLIP", "CIRCLE", "THROW"])
def test_modes_that_a_person_alone_chooses_are_a_pilots(name: str) -> None:
    """A gateway that has just started finds it armed in one: it is not commanded."""
    control = Control()
    control.hear(COPTER.numbers[name], True, "", COPTER, 1.0)
    assert control.seized is not None
    assert control.seized.by == "pilot"


def test_a_pilot_is_seen_after_heartbeats_on_the_ground() -> None:
    """Disarmed it is nobody's, as often as that is said; armed again in a mode flown by hand it is a pilot's."""
    control = flying()
    for now in (2.0, 3.0, 4.0):
        control.hear(STABILIZE, False, "", COPTER, now)
        assert control.seized is None
    control.hear(STABILIZE, True, "", COPTER, 5.0)
    assert control.seized is not None


def test_what_was_ordered_on_the_ground_holds_for_the_flight() -> None:
    """GUIDED, heard disarmed, then armed: another mode is a takeover; after the flight that order counts no more."""
    control = Control()
    control.hear(STABILIZE, False, "", COPTER, 0.5)
    control.order(GUIDED, 1.0)
    for now, mode in ((1.5, STABILIZE), (2.0, GUIDED), (3.0, GUIDED)):
        control.hear(mode, False, "", COPTER, now)
    control.hear(GUIDED, True, "", COPTER, 4.0)
    assert control.seized is None
    control.hear(RTL, True, "", COPTER, 5.0)
    assert control.seized is not None
    control.hear(RTL, False, "", COPTER, 6.0)
    control.hear(AUTO, False, "", COPTER, 7.0)
    control.hear(AUTO, True, "", COPTER, 8.0)
    assert control.seized is None


def test_an_order_that_was_lost_on_the_ground_hides_no_pilot() -> None:
    """The mode before is excused while the change is in flight, no longer."""
    control = Control()
    control.hear(STABILIZE, False, "", COPTER, 0.5)
    control.order(GUIDED, 1.0)
    control.hear(STABILIZE, True, "", COPTER, 2.0)
    assert control.seized is None
    control.hear(STABILIZE, True, "", COPTER, 1.0 + CHANGE_S + 0.1)
    assert control.seized is not None


def test_the_mode_before_is_no_answer_while_a_change_is_in_flight() -> None:
    """Ordered back to the mode it is still in, the order in between may yet show: that is no takeover."""
    control = flying(GUIDED)
    control.order(AUTO, 2.0)
    control.order(GUIDED, 2.1)
    control.hear(AUTO, True, "", COPTER, 2.2)
    assert control.seized is None
    control.hear(GUIDED, True, "", COPTER, 2.3)
    control.hear(AUTO, True, "", COPTER, 3.3)
    assert control.seized is not None


def test_a_failsafe_seizes_and_ends_only_with_its_cause() -> None:
    """While a failsafe is in force neither the ordered mode nor an operator gets it back for long."""
    control = flying()
    control.hear(RTL, True, "battery critical", COPTER, 2.0)
    assert control.seized is not None
    assert control.seized.by == "failsafe"
    assert "battery critical" in control.seized.why
    control.hear(AUTO, True, "battery critical", COPTER, 3.0)
    assert control.seized is not None
    assert control.release() is not None
    control.hear(RTL, True, "battery critical", COPTER, 4.0)
    assert control.seized is not None
    control.hear(GUIDED, True, "", COPTER, 5.0)
    assert control.seized is None


def test_sticks_over_the_gateway() -> None:
    """Moved sticks seize an armed vehicle and let it go when they rest; a joystick at rest is nothing."""
    control = flying(GUIDED)
    assert not control.sticks(255, False, 2.0)
    assert control.sticks(255, True, 2.0)
    control.hear(GUIDED, True, "", COPTER, 2.0 + STICKS_S / 2)
    assert control.seized is not None
    control.hear(GUIDED, True, "", COPTER, 2.1 + STICKS_S)
    assert control.seized is None
    assert not Control().sticks(255, True, 0.0)  # on the ground


def test_which_sticks_count_as_moved() -> None:
    """Released channels, the middle and unused axes are rest; a deflection is not."""
    channels = {f"chan{number}_raw": 0 for number in range(1, 9)} | {"target_system": 1, "target_component": 1}
    assert not moved("RC_CHANNELS_OVERRIDE", make("RC_CHANNELS_OVERRIDE", **channels))
    channels |= {"chan1_raw": 1510, "chan2_raw": 65535}
    assert not moved("RC_CHANNELS_OVERRIDE", make("RC_CHANNELS_OVERRIDE", **channels))
    assert moved("RC_CHANNELS_OVERRIDE", make("RC_CHANNELS_OVERRIDE", **(channels | {"chan2_raw": 1700})))
    axes = {"target": 1, "x": 0, "y": 10, "z": 500, "r": 32767, "buttons": 0}
    assert not moved("MANUAL_CONTROL", make("MANUAL_CONTROL", **axes))
    assert moved("MANUAL_CONTROL", make("MANUAL_CONTROL", **(axes | {"x": -600})))


def test_an_operator_takes_it_back_from_a_pilot() -> None:
    """After a release the pilot's mode is where things start, not another takeover."""
    control = flying()
    control.hear(LOITER, True, "", COPTER, 2.0)
    assert control.release() is not None
    control.hear(LOITER, True, "", COPTER, 3.0)
    assert control.seized is None
    assert control.release() is None
    # Neither is it while the first order after it is on its way; another mode than these two is.
    control.order(GUIDED, 4.0)
    control.hear(LOITER, True, "", COPTER, 4.5)
    assert control.seized is None
    control.hear(STABILIZE, True, "", COPTER, 5.0)
    assert control.seized is not None


@given(
    st.lists(
        st.tuples(st.sampled_from(["order", "wait", "fly", "land"]), st.sampled_from(sorted(COPTER.plain | {"AUTO"}))),
        max_size=20,
    ),
    st.sampled_from(sorted(COPTER.by_hand - {"LOITER"})),  # to which ArduCopter itself goes on from BRAKE
)
def test_a_mode_flown_by_hand_is_always_a_takeover(events: list[tuple[str, str]], by_hand: str) -> None:
    """Whatever was ordered and heard before, on the ground or in the air: a gateway never chooses such a mode."""
    control = Control()
    now = 0.0
    for what, name in events:
        now += CHANGE_S if what == "wait" else 1.0
        if what == "order":
            control.order(COPTER.numbers[name], now)
        elif what != "wait":
            control.hear(COPTER.numbers[name], what == "fly", "", COPTER, now)
    control.hear(COPTER.numbers[by_hand], True, "", COPTER, now + 1.0)
    assert control.seized is not None
    control.hear(GUIDED, True, "", COPTER, now + 2.0)
    assert control.seized is None


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["order", "hear", "sticks", "release"]),
            st.sampled_from(sorted(COPTER.numbers.values())),
            st.booleans(),
            st.sampled_from(["", "failsafe"]),
        ),
        max_size=30,
    )
)
def test_what_holds_whatever_happens(events: list[tuple[str, int, bool, str]]) -> None:
    """Disarmed it is nobody's; without a failsafe nobody but a pilot has it; a reason always comes with it."""
    control = Control()
    now = 0.0
    for what, mode, flag, failsafe in events:
        now += 1.0
        match what:
            case "order":
                control.order(mode, now)
            case "hear":
                control.hear(mode, flag, failsafe, COPTER, now)
                assert flag or control.seized is None
                assert not (flag and failsafe) or control.seized is not None
            case "sticks":
                control.sticks(255, flag, now)
            case _:
                control.release()
                assert control.seized is None
        assert control.seized is None or (control.seized.why and control.seized.by in ("pilot", "failsafe"))


def test_modes_by_kind() -> None:
    """Numbers mean something else for each kind of vehicle; kinds that are not known have no modes."""
    assert modes_of(3, 2) is COPTER
    assert modes_of(3, 10) is ROVER
    assert modes_of(3, 1) is None  # a plane
    assert modes_of(12, 2) is None  # PX4
    assert (COPTER.name(4), ROVER.name(4), ROVER.name(99)) == ("GUIDED", "HOLD", "99")
