"""Two versions in one fleet: what a newer one adds is no error to an older one, and what cannot work is told."""

import typing
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import GatewayStatus, gateways, keyspace

OF_PEOPLE = frozenset(
    {
        "TaskRequest",
        "CancelTaskAsk",
        "MigrateAsk",
        "ScheduleSpec",
        *("Recipe", "Data", "Clients", "Training", "Optimiser", "Rounds", "Update", "Dp", "Evaluation", "Emulation"),
    }
)
"""What a person has ordered, which gateways pass on: what is not known there is refused, not left out."""


def strict(kind: Any, seen: set[Any]) -> set[str]:
    """Return the structs within a type that refuse unknown fields."""
    found: set[str] = set()
    for part in typing.get_args(kind):
        found |= strict(part, seen)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct) and kind not in seen:
        seen.add(kind)
        if kind.__struct_config__.forbid_unknown_fields:
            found.add(kind.__name__)
        for field in msgspec.structs.fields(kind):
            found |= strict(field.type, seen)
    return found


@pytest.mark.parametrize("topic", keyspace.TOPICS, ids=lambda topic: topic.text)
def test_what_is_put_may_have_more_in_it(topic: Any) -> None:
    """A gateway of the version before ignores the fields that a newer one adds to what it puts."""
    assert strict(topic.payload, set()) <= OF_PEOPLE


@pytest.mark.parametrize("verb", keyspace.VERBS, ids=lambda verb: verb.name)
def test_what_gateways_ask_and_answer_may_have_more_in_it(verb: Any) -> None:
    """Answers ignore more fields, and so do the questions that only gateways ask."""
    assert strict(verb.reply, set()) <= OF_PEOPLE
    if set(verb.asks) == set(keyspace.GATEWAYS) or verb is keyspace.STANDING:
        assert strict(verb.request, set()) <= OF_PEOPLE


def test_a_status_of_either_version_is_read_by_the_other() -> None:
    """One from before there were protocols counts as protocol 1; one with more in it is read as far as it is known."""
    old = msgspec.json.decode(b'{"id":"g1","fleet":"f","version":"0.0.9"}', type=GatewayStatus)
    assert (old.protocol, old.oldest_protocol) == (1, 1)
    text = b'{"id":"g2","fleet":"f","version":"9.0","protocol":2,"oldest_protocol":1,"later":{"a":[1]}}'
    new = msgspec.json.decode(text, type=GatewayStatus)
    assert (new.version, new.protocol) == ("9.0", 2)
    assert gateways.works_beside(old)
    assert gateways.works_beside(new)


@given(st.integers(1, 9), st.integers(0, 9), st.integers(1, 9), st.integers(0, 9))
def test_both_find_the_same(one: int, one_back: int, two: int, two_back: int) -> None:
    """Whether two can be in one fleet does not depend on who of them is asked."""

    def asked(own: int, own_oldest: int, other: int, other_oldest: int) -> bool:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(gateways, "PROTOCOL", own)
            patch.setattr(gateways, "OLDEST_PROTOCOL", own_oldest)
            status = GatewayStatus(id="g", fleet="f", protocol=other, oldest_protocol=other_oldest)
            return gateways.works_beside(status)

    first, second = (one, max(1, one - one_back)), (two, max(1, two - two_back))
    assert asked(*first, *second) == asked(*second, *first)
    assert asked(*first, *first)
