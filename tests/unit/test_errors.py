"""The error tree: what a command ends with, and what travels between gateways."""

import pytest

from appliance import cli
from appliance.errors import (
    CancelledByOperatorError,
    ConfigError,
    ConflictError,
    ContractError,
    DeadlineError,
    Exit,
    IdentityError,
    NotFoundError,
    PayloadError,
    PlanError,
    PoolError,
    PreconditionError,
    PrerequisiteError,
    RecordError,
    RefusedError,
    RobotError,
    SwiftbotError,
    TakenError,
    UnapprovedError,
    UnreachableError,
    from_code,
)
from appliance.identity.credentials import OlderRosterError

ENDS = {
    SwiftbotError: Exit.FAILED,
    ConfigError: Exit.USAGE,
    PayloadError: Exit.REFUSED,
    PreconditionError: Exit.REFUSED,
    PrerequisiteError: Exit.MISSING,
    UnreachableError: Exit.UNREACHABLE,
    DeadlineError: Exit.LATE,
    ConflictError: Exit.REFUSED,
    NotFoundError: Exit.REFUSED,
    RefusedError: Exit.REFUSED,
    PlanError: Exit.REFUSED,
    PoolError: Exit.FAILED,
    RobotError: Exit.FAILED,
    TakenError: Exit.REFUSED,
    ContractError: Exit.FAILED,
    UnapprovedError: Exit.REJECTED,
    RecordError: Exit.FAILED,
    IdentityError: Exit.DENIED,
    CancelledByOperatorError: Exit.CANCELLED,
}


def _all(root: type[SwiftbotError]) -> set[type[SwiftbotError]]:
    return {root}.union(*(_all(each) for each in root.__subclasses__() if each.__module__ == "appliance.errors"))


@pytest.mark.parametrize("kind", ENDS, ids=lambda each: each.__name__)
def test_a_command_ends_with_the_code_of_its_error(
    kind: type[SwiftbotError], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever is declined and changes nothing ends alike, a conflict among it; first the cause, then the remedy."""

    def fail(*_: object, **__: object) -> None:
        raise kind("the cause", remedy="the remedy")

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit) as ended:
        cli.main([])
    assert ended.value.code == ENDS[kind]
    told = capsys.readouterr().err
    assert 0 <= told.find("the cause") < told.find("the remedy")


def test_each_error_of_the_tree_has_a_place_in_the_table() -> None:
    """No error was forgotten above, each has a code of its own, and comes back from that code as what it was."""
    assert _all(SwiftbotError) == set(ENDS)
    assert len({kind.code for kind in ENDS}) == len(ENDS)
    for kind in ENDS:
        assert type(from_code(kind.code, "x")) is kind
    assert type(from_code("of another version", "x")) is SwiftbotError


def test_an_error_of_one_room_travels_as_its_kind() -> None:
    """An error without a code of its own is what it was made from, wherever it arrives."""
    assert issubclass(OlderRosterError, IdentityError)
    assert type(from_code(OlderRosterError("x").code, "x")) is IdentityError
