"""The table of keys: what is made of names is taken apart into them again, and every record of gateways is guarded."""

import re

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.model import keyspace
from appliance.model.keys import Template
from appliance.model.steering import Signed

CHUNKS = st.text(st.characters(codec="utf-8", exclude_characters="/*$?#", exclude_categories=("Cc", "Cs")), min_size=1)
TEMPLATES = [Template("task/{task}/run/{subtask}"), Template("a/{b}"), Template("none"), *keyspace.RECORD_KINDS]


@given(st.sampled_from(TEMPLATES), st.lists(CHUNKS, min_size=4, max_size=4))
def test_a_key_is_taken_apart_into_its_names(template: Template, chunks: list[str]) -> None:
    """Whatever the names are; a further chunk makes another key of it."""
    names = tuple(chunks[: len(template.fields)])
    key = template.key(*names)
    assert template.match(key) == names
    zenoh.KeyExpr(key)
    assert template.match(f"{key}/x") is None
    assert template.match(f"x/{key}") is None


@given(st.text(max_size=30))
def test_a_name_stays_within_its_chunk(name: str) -> None:
    """What would be several chunks, none, or a wildcard is refused; the rest makes a key that Zenoh takes."""
    try:
        key = Template("task/{task}/record").key(name)
    except PayloadError:
        assert not name or re.search(r"[/*$?#\x00-\x1f\x7f]", name)
        return
    assert str(zenoh.KeyExpr(key)) == key
    assert key.count("/") == 2


@given(st.text(max_size=60))
def test_any_text_can_be_matched(key: str) -> None:
    """A key of another form has no names; nothing that is heard raises."""
    for template in TEMPLATES:
        names = template.match(key)
        assert names is None or len(names) == len(template.fields)


def test_a_key_needs_all_its_names() -> None:
    """One too few or too many is refused."""
    for names in ((), ("a",), ("a", "b", "c")):
        with pytest.raises(PayloadError, match="2 names"):
            Template("task/{task}/run/{subtask}").key(*names)


@pytest.mark.parametrize("key", ["ask/t-1/s1/1", "ask/x", "effect/", "lease/rover_1", "task/t-1", "volume/maps"])
def test_records_that_gateways_write_are_known(key: str) -> None:
    """Whole, and of a form that nobody writes."""
    kind = keyspace.record_kind(key)
    assert kind is not None
    assert kind.owns(key)


@pytest.mark.parametrize("key", ["note/1", "ask", "tasks/1", "", "x/task/1"])
def test_other_records_are_anybodys(key: str) -> None:
    """What begins with no kind of theirs."""
    assert keyspace.record_kind(key) is None


def test_each_key_says_who_may() -> None:
    """A verb that nobody may ask, or a topic that nobody may put to, is one whose roles were forgotten."""
    assert [verb.name for verb in keyspace.VERBS if not verb.asks] == []
    silent = [topic.text for topic in keyspace.TOPICS if not topic.puts and not topic.answers and topic.form != "log"]
    assert silent == []


def test_what_names_its_operator_is_signed() -> None:
    """An order that says who gives it is one of that name only with a signature."""
    orders = [verb for verb in keyspace.VERBS if issubclass(verb.request, Signed)]
    assert len(orders) > 20
    assert [verb.name for verb in orders if not verb.signed] == []


def test_names_are_unique() -> None:
    """No verb is there twice, nor two kinds of records of one prefix."""
    verbs = [verb.name for verb in keyspace.VERBS]
    prefixes = [kind.prefix for kind in keyspace.RECORD_KINDS]
    assert len(set(verbs)) == len(verbs) > 60
    assert len(set(prefixes)) == len(prefixes)
