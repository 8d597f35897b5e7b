"""Zenoh's access control, made from the table of keys: what each role may send to a gateway, and be sent by it.

Everything is denied that the table does not allow; a key without roles is open to none. The rules are fixed once a
session is open (zenoh issue 2169), so it is opened again for other robots (`plane.reopening`). They compare common
names as a whole: all of a role share one (`identity.certificates`), and only the robots that the roster names when the
session opens are let in.

Zenoh filters what is declared as well as what is sent: a subscription is let in where the rule covers all keys that it
would match. What comes in and what goes out are separate rules, from the point of view of the session that has them:

| the other side | comes in from it | goes out to it |
| --- | --- | --- |
| puts, deletes | `put`, `delete` | `declare_subscriber`: that there is a subscriber |
| reads | `declare_subscriber` | `put`, `delete` |
| shows a token | `liveliness_token` | `liveliness_query`, `declare_liveliness_subscriber` |
| looks for tokens | `liveliness_query`, `declare_liveliness_subscriber` | `liveliness_token` |
| answers | `declare_queryable`, `reply` | `query` |
| asks | `query` | `declare_queryable`, `reply` |

A session that only dials is linked with gateways only, as TLS proves; its rules let these do everything in the fleet,
and no other role: a server with a public authority's certificate, which Zenoh trusts when it dials, has no such
common name.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Final

from msgspec import Struct

from appliance.identity.certificates import common_name
from appliance.model import keyspace
from appliance.model.keys import Keys, Topic, Verb
from appliance.model.roles import Role

PUT: Final = ("put", "delete")
LISTEN: Final = ("declare_subscriber",)
TOKEN: Final = ("liveliness_token",)
LOOK: Final = ("liveliness_query", "declare_liveliness_subscriber")
ANSWER: Final = ("declare_queryable", "reply")
ASK: Final = ("query",)
WAIT: Final = ("declare_queryable", "reply")
"""What one that asks is sent: that there is a queryable, and the answer."""
ALL: Final = (*PUT, *LISTEN, *TOKEN, *LOOK, *ANSWER, *ASK)

READ_ALL = frozenset({Role.RECORDER, Role.VIEWER, Role.OPERATOR, Role.ENGINEER})
"""Roles that may subscribe to everything at once, since there is nothing that they may not read."""


class Rule(Struct, frozen=True):
    """What one common name may do."""

    subject: str
    """A common name."""
    incoming: bool
    """Whether it is about what comes in from there, or about what goes out to it."""
    messages: tuple[str, ...]
    expressions: tuple[str, ...]
    """Key expressions; a message's own must be within one of them."""


def rules(
    fleet: str,
    *,
    robots: Iterable[str],
    barred: Iterable[str] = (),
    topics: Sequence[Topic[Any]] = keyspace.TOPICS,
    verbs: Sequence[Verb[Any, Any]] = keyspace.VERBS,
) -> list[Rule]:
    """All rules of a session that accepts links.

    Args:
        fleet: its name.
        robots: those that are let in.
        barred: robots whose certificates are revoked: they hear commands, so that one that moves can be stopped.
        topics: the table of keys.
        verbs: the verbs of its `gw/{gateway}/rpc/{verb}`.
    """
    keys = Keys(fleet)
    found: list[Rule] = []
    for role in Role:
        if role is not Role.ROBOT:
            found += _of(keys, role, "", topics, verbs)
    for robot in sorted(set(robots)):
        found += _of(keys, Role.ROBOT, robot, topics, verbs)
    for robot in sorted(set(barred)):
        found += _of(keys, Role.ROBOT, robot, (keyspace.COMMAND,), ())
    return found


def dialling_rules(fleet: str) -> list[Rule]:
    """The rules of a session that only dials: gateways may do everything, others nothing."""
    keys = Keys(fleet)
    expressions = (keys.everything, keys(keyspace.BACKLOG))
    gateway = common_name(Role.GATEWAY, "")
    return [Rule(gateway, incoming, ALL, expressions) for incoming in (True, False)]


def _of(keys: Keys, role: Role, name: str, topics: Sequence[Topic[Any]], verbs: Sequence[Verb[Any, Any]]) -> list[Rule]:
    """The rules of one role; of a robot, by its name."""

    def expression(topic: Topic[Any]) -> str:
        own = name if role is Role.ROBOT else "*"
        return keys(topic, *(own if field == "robot" else "*" for field in topic.fields))

    def chosen(what: str, *, token: bool = False) -> tuple[str, ...]:
        """The keys where the role does something, which is a field of `Topic`."""
        return tuple(
            expression(each) for each in topics if role in getattr(each, what) and (each.form == "token") is token
        )

    asked = tuple(keys(keyspace.RPC, "*", verb.name) for verb in verbs if role in verb.asks)
    read = chosen("reads")
    # What a gateway answers it declares all at once, behind one key for all its verbs.
    waits = (*chosen("asks"), *asked, *((keys(keyspace.RPC, "*", "*"),) if asked else ()))
    everything = (keys.everything,) if role in READ_ALL else ()
    pairs = (
        (True, PUT, chosen("puts")),
        (False, LISTEN, (*chosen("puts"), keys.everything) if chosen("puts") else ()),
        (True, LISTEN, (*read, *everything)),
        (False, PUT, read),
        (True, TOKEN, chosen("puts", token=True)),
        (False, LOOK, chosen("puts", token=True)),
        (True, LOOK, chosen("reads", token=True)),
        (False, TOKEN, chosen("reads", token=True)),
        (True, ANSWER, chosen("answers")),
        (False, ASK, chosen("answers")),
        (True, ASK, (*chosen("asks"), *asked)),
        (False, WAIT, waits),
    )
    subject = common_name(role, name)
    return [Rule(subject, incoming, messages, expressions) for incoming, messages, expressions in pairs if expressions]


def zenoh_settings(made: Sequence[Rule]) -> dict[str, Any]:
    """The rules as Zenoh's configuration has them, `access_control`."""
    subjects = tuple(dict.fromkeys(rule.subject for rule in made))
    numbered = [(f"{rule.subject} {number}", rule) for number, rule in enumerate(made)]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": name,
                "messages": list(rule.messages),
                "flows": ["ingress" if rule.incoming else "egress"],
                "permission": "allow",
                "key_exprs": list(rule.expressions),
            }
            for name, rule in numbered
        ],
        "subjects": [{"id": subject, "cert_common_names": [subject]} for subject in subjects],
        "policies": [
            {"rules": [name for name, rule in numbered if rule.subject == subject], "subjects": [subject]}
            for subject in subjects
        ],
    }
