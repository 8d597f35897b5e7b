"""Access control made from the table of keys: every key, every role, and nothing that the table does not say."""
# pyright: reportUnknownMemberType=false

from collections.abc import Sequence
from typing import Any

import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from appliance.identity import access
from appliance.identity.access import ALL, ASK, LISTEN, PUT, TOKEN, Rule
from appliance.identity.certificates import common_name
from appliance.model import keyspace
from appliance.model.keys import Keys, Topic, Untyped, Verb
from appliance.model.plane_api import KeyAsk
from appliance.model.roles import Role
from appliance.operations import OPERATIONS
from workshop.robots.world import WORLD, WORLD_OF

KEYS = Keys("yard")
RULES = access.rules("yard", robots=("drone_1", "drone_2"))


def allowed(made: Sequence[Rule], subject: str, message: str, expression: str, *, incoming: bool = True) -> bool:
    """Return what Zenoh decides: allowed where a rule's expression includes that of the message."""
    asked = zenoh.KeyExpr(expression)
    return any(
        rule.subject == subject
        and rule.incoming is incoming
        and message in rule.messages
        and any(zenoh.KeyExpr(each).includes(asked) for each in rule.expressions)
        for rule in made
    )


def example(topic: Topic[Any], robot: str = "drone_1") -> str:
    """Return a key of a topic, of that robot where it has one."""
    return KEYS(topic, *(robot if field == "robot" else "one" for field in topic.fields))


def subject_of(role: Role) -> str:
    """Return the common name of a role; of robots, that of drone_1."""
    return common_name(role, "drone_1")


@pytest.mark.parametrize("topic", keyspace.TOPICS, ids=lambda topic: topic.text)
@pytest.mark.parametrize("role", tuple(Role))
def test_each_role_does_at_each_key_what_the_table_says(role: Role, topic: Topic[Any]) -> None:
    """No more and no less: puts, subscriptions, tokens, answers and questions, each both ways."""
    subject, key = subject_of(role), example(topic)
    token = topic.form == "token"
    # What falls under an expression that the role has anyway, as all keys do for those who may read everything.
    reads = (not token and role in topic.reads) or (role in access.READ_ALL and "@" not in topic.text)
    asked = role in topic.asks
    expected = {
        ("put", True): not token and role in topic.puts,
        ("delete", True): not token and role in topic.puts,
        ("put", False): not token and role in topic.reads,
        ("declare_subscriber", True): reads,
        ("liveliness_token", True): token and role in topic.puts,
        ("liveliness_token", False): token and role in topic.reads,
        ("declare_liveliness_subscriber", True): token and role in topic.reads,
        ("liveliness_query", True): token and role in topic.reads,
        ("declare_queryable", True): role in topic.answers,
        ("reply", True): role in topic.answers,
        ("query", False): role in topic.answers,
        ("query", True): asked,
    }
    if topic is keyspace.RPC:  # of a verb that there is not; see the test of verbs
        expected[("query", True)] = False
    found = {
        (message, incoming): allowed(RULES, subject, message, key, incoming=incoming) for message, incoming in expected
    }
    assert found == expected


@pytest.mark.parametrize("verb", keyspace.VERBS, ids=lambda verb: verb.name)
def test_verbs_are_asked_by_the_roles_of_the_table(verb: Verb[Any, Any]) -> None:
    """One gateway or, with a wildcard, all of them; answers go to those who may ask."""
    for gateway in ("gw-1", "*"):
        key = KEYS(keyspace.RPC, gateway, verb.name)
        asking = {role for role in Role if allowed(RULES, subject_of(role), "query", key)}
        assert asking == verb.asks
        answered = {role for role in Role if allowed(RULES, subject_of(role), "reply", key, incoming=False)}
        assert answered >= verb.asks


def test_a_key_without_roles_is_nobodys() -> None:
    """Whatever is added to the table later is denied to everybody until it says who may."""
    topic = Topic("gw/{gateway}/new", Untyped, writer="–")
    token = Topic("gw/{gateway}/there", Untyped, form="token", writer="–")
    verb = Verb("new", KeyAsk, KeyAsk, "–")
    made = access.rules(
        "yard",
        robots=("drone_1",),
        topics=(*keyspace.TOPICS, topic, token),
        verbs=(*keyspace.VERBS, verb),
    )
    keys = (example(topic), example(token), KEYS(keyspace.RPC, "gw-1", "new"))
    can = {
        (role, message, key)
        for role in Role
        for key in keys
        for message in (*PUT, *TOKEN, *ASK)
        if allowed(made, subject_of(role), message, key)
    }
    assert can == set()
    assert not allowed(made, subject_of(Role.GATEWAY), "declare_subscriber", keys[0])


@pytest.mark.parametrize("topic", [WORLD, WORLD_OF, *(each for each in keyspace.TOPICS if each.form == "log")])
def test_what_is_never_put_in_a_real_fleet_is_denied(topic: Topic[Any]) -> None:
    """The simulated world, and what only logs have."""
    assert not any(allowed(RULES, subject_of(role), "put", example(topic)) for role in Role)


@pytest.mark.parametrize(
    "topic", [each for each in keyspace.TOPICS if "robot" in each.fields], ids=lambda each: each.text
)
def test_a_robot_is_held_to_its_own_name(topic: Topic[Any]) -> None:
    """It neither reads, writes, answers nor asks where another robot's name stands, or a wildcard for it."""
    for robot in ("drone_2", "drone_3", "*"):
        key = example(topic).replace("drone_1", robot)
        for message in ALL:
            for incoming in (True, False):
                # Others' wish to hear something is no secret, and names nobody.
                if not incoming and message in LISTEN:
                    continue
                assert not allowed(RULES, "robot:drone_1", message, key, incoming=incoming), (message, key, incoming)


@given(
    st.sampled_from(tuple(Role)), st.sampled_from(ALL), st.booleans(), st.lists(st.sampled_from(["**", "*", "gw", "x"]))
)
def test_nothing_is_allowed_in_another_fleet(role: Role, message: str, incoming: bool, rest: list[str]) -> None:
    """Nor outside the fleet's root, nor for a robot that the roster lacks."""
    for root in ("swiftbot/dock", "swiftbot", "swiftbot/*", "@", "**"):
        key = str(zenoh.KeyExpr.autocanonize("/".join((root, *rest))))
        assert not allowed(RULES, subject_of(role), message, key, incoming=incoming)
    assert not any(rule.subject == "robot:drone_3" for rule in RULES)


@given(st.sampled_from(tuple(Role)), st.sampled_from([*PUT, *TOKEN, "query", "declare_queryable", "reply"]))
def test_wildcards_do_not_reach_beyond_a_rule(role: Role, message: str) -> None:
    """A member that may write some keys may not write an expression that matches others too."""
    for expression in (KEYS.everything, f"{KEYS.root}/*/*/*", f"{KEYS.root}/gw/**", f"{KEYS.root}/robot/**"):
        assert not allowed(RULES, subject_of(role), message, expression)


def test_a_session_that_only_dials_obeys_gateways_alone() -> None:
    """Who else may have a certificate that TLS takes, one of the web's authorities, has no say."""
    made = access.dialling_rules("yard")
    assert {rule.subject for rule in made} == {"gateway"}
    assert allowed(made, "gateway", "put", example(keyspace.STATUS))
    assert allowed(made, "gateway", "query", KEYS(keyspace.BACKLOG, "1a"))
    assert not allowed(made, "gateway", "put", "swiftbot/dock/gw/one/status")


def test_a_barred_robot_hears_commands_and_nothing_else() -> None:
    """So that one that moves can be stopped; it puts, reads, asks and shows nothing."""
    made = access.rules("yard", robots=(), barred=("drone_1",))
    own = KEYS(keyspace.COMMAND, "drone_1")
    robots = [rule for rule in made if rule.subject == "robot:drone_1"]
    assert {expression for rule in robots for expression in rule.expressions} == {own}
    assert {(rule.incoming, rule.messages) for rule in robots} == {(True, access.ANSWER), (False, access.ASK)}


def test_operations_need_the_role_that_their_verb_needs() -> None:
    """What the command line and the terminal UI say of a command is what gateways hold people to."""
    verbs = {verb.name: verb for verb in keyspace.VERBS}
    for operation in OPERATIONS:
        # Some are recorded under names of their own: what a verb was asked to do.
        if operation.audit in verbs:
            assert operation.role in verbs[operation.audit].asks, operation.name


def test_zenoh_takes_the_rules() -> None:
    """As its configuration, with every rule in a policy of its subject."""
    config = zenoh.Config()
    made = access.zenoh_settings(RULES)
    config.insert_json5("access_control", msgspec.json.encode(made).decode())
    assert {name for each in made["policies"] for name in each["rules"]} == {each["id"] for each in made["rules"]}
    assert made["default_permission"] == "deny"
