"""Key names."""

from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.model import keyspace
from appliance.model.keys import Keys, Topic, check_name, fleet_and_rest


@given(st.text(max_size=80))
def test_a_name_is_one_chunk_or_refused(name: str) -> None:
    """Whatever the text: it is refused, or it makes keys that Zenoh takes and that stay in their place."""
    try:
        check_name(name, "gateway")
    except PayloadError:
        return
    key = Keys("fleet")(keyspace.STATUS, name)
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
    assert not zenoh.KeyExpr(one.everything).intersects(zenoh.KeyExpr(other(keyspace.STATUS, "g")))


def test_every_key_is_within_the_fleet() -> None:
    """What the recorder subscribes to covers every key that can be put, and each is of its own topic alone."""
    keys = Keys("f")
    for topic in keyspace.TOPICS:
        key = keys(topic, *(f"{field}1" for field in topic.fields))
        assert zenoh.KeyExpr(keys(topic)).includes(zenoh.KeyExpr(key))
        assert zenoh.KeyExpr(keys.everything).includes(zenoh.KeyExpr(key)) or topic is keyspace.BACKLOG
        assert keyspace.topic_of(key) is topic
        assert topic.names(key) == tuple(f"{field}1" for field in topic.fields)


@given(st.sampled_from(keyspace.TOPICS), st.text(max_size=30))
def test_names_left_out_match_all_and_hostile_ones_are_refused(topic: Topic[Any], name: str) -> None:
    """A name is one chunk or refused, in a key as in an expression."""
    keys = Keys("f")
    if not topic.fields:
        return
    for rest in ((), tuple("b" for _ in topic.fields[1:])):
        try:
            made = keys(topic, name, *rest)
        except PayloadError:
            continue
        assert str(zenoh.KeyExpr(made)) == made
        assert made.count("/") == keys(topic).count("/")


@given(st.text(max_size=60))
def test_any_key_can_be_asked_for_its_topic(key: str) -> None:
    """Nothing that is heard raises."""
    assert keyspace.topic_of(key) is None
    assert keyspace.topic_of(f"swiftbot/f/gw/{key}") is None or "/" in key


@pytest.mark.parametrize(
    ("key", "parts"),
    [("swiftbot/f/gw/g/log", ("f", "gw/g/log")), ("swiftbot/f", ("", "swiftbot/f")), ("x/y", ("", "x/y"))],
)
def test_a_key_names_its_fleet(key: str, parts: tuple[str, str]) -> None:
    """One under no fleet is left whole."""
    assert fleet_and_rest(key) == parts
