"""What a person's role is enough for."""

import pytest

from appliance.model.roles import PEOPLE, Role, lacks


@pytest.mark.parametrize(
    ("own", "enough"),
    [
        (Role.VIEWER, {Role.VIEWER}),
        (Role.OPERATOR, {Role.VIEWER, Role.OPERATOR}),
        (Role.ENGINEER, {Role.VIEWER, Role.OPERATOR, Role.ENGINEER}),
    ],
)
def test_each_role_may_what_the_ones_before_it_may(own: Role, enough: set[Role]) -> None:
    """An engineer what an operator may, an operator what a viewer may."""
    assert {needed for needed in PEOPLE if not lacks(own, needed)} == enough


def test_without_keys_there_are_no_roles() -> None:
    """Within one machine everybody may do everything; what is no person is held to the table of keys alone."""
    for needed in PEOPLE:
        assert not lacks(None, needed)
        assert not lacks(Role.GATEWAY, needed)
