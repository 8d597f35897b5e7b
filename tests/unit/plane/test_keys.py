"""Key names."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.plane.keys import Keys, check_name, run_of


@given(st.text(max_size=80))
def test_a_name_is_one_chunk_or_refused(name: str) -> None:
    """Whatever the text: it is refused, or it makes keys that Zenoh takes and that stay in their place."""
    try:
        check_name(name, "gateway")
    except PayloadError:
        return
    key = Keys("fleet").status(name)
    zenoh.KeyExpr(key)
    assert key.split("/") == ["swiftbot", "fleet", "gw", name, "status"]


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "A", "a$", "a#", "a?", "x" * 64, "-a", "ä", "a\n"])
def test_bad_names_are_refused(name: str) -> None:
    """A name that would be no single chunk, or could match others, is refused with the rule."""
    with pytest.raises(PayloadError, match="a-z"):
        check_name(name, "robot")


def test_a_fleet_has_its_own_keys() -> None:
    """Fleets never meet: no key of one matches another's."""
    one, other = Keys("one"), Keys("other")
    assert not zenoh.KeyExpr(one.everything()).intersects(zenoh.KeyExpr(other.status("g")))


def test_every_key_is_within_the_fleet() -> None:
    """What the recorder subscribes to covers every key."""
    keys = Keys("f")
    everything = zenoh.KeyExpr(keys.everything())
    made = [
        keys.alive("g"), keys.status("g"), keys.container("g", "c"), keys.rpc("g", "v"), keys.exchange("g", "v"),
        keys.log("g"), keys.task("t"), keys.transition("t"), keys.run("t", "s"), keys.robot_alive("r"),
        keys.robot("r"), keys.command("r"), keys.commanded("r"), keys.camera("r"), keys.mavlink("r", "rx"),
        keys.intake("r"), keys.notice("n"), keys.recorder_status("r"),
    ]  # fmt: skip
    assert len(set(made)) == len(made)
    assert all(everything.includes(zenoh.KeyExpr(key)) for key in made)


def test_a_run_events_key_names_task_and_subtask() -> None:
    """Of other keys, and of what is no key, it names nothing."""
    keys = Keys("f")
    assert run_of(keys.run("t-1", "s2")) == ("t-1", "s2")
    for other in (keys.task("t-1"), keys.log("g"), "run", "/run/", "", "a/run/b"):
        assert run_of(other) == ("", "")
