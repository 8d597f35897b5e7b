"""Roles: what a certificate says its holder is, and what the table of keys says may write and read."""

from appliance.model.messages import OpenEnum


class Role(OpenEnum):
    """What the holder of a certificate may do in the fleet."""

    GATEWAY = "gateway"
    """A gateway or a router: keeps records, coordinates and runs tasks, answers verbs."""
    RECORDER = "recorder"
    """Reads every message of the fleet and tells how its log is."""
    ROBOT = "robot"
    """Puts its own state, answers commands to itself, and submits tasks."""
    VIEWER = "viewer"
    """Reads; the soft stop is open to it too."""
    OPERATOR = "operator"
    """Reads, submits tasks, steers tasks and robots."""
    ENGINEER = "engineer"
    """What an operator may, and changes gateways, pools, models and records."""


PEOPLE = frozenset({Role.VIEWER, Role.OPERATOR, Role.ENGINEER})
OPERATORS = frozenset({Role.OPERATOR, Role.ENGINEER})


_LEAST = {Role.VIEWER: PEOPLE, Role.OPERATOR: OPERATORS, Role.ENGINEER: frozenset({Role.ENGINEER})}


def lacks(own: Role | None, needed: Role) -> bool:
    """Whether a person's role is less than the one that an operation needs; None: there are no keys, and no roles."""
    return own in PEOPLE and own not in _LEAST.get(needed, frozenset())
