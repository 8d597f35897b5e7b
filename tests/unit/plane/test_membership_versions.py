"""Gateways whose versions do not work together: the later one goes with a clear reason, the fleet is not disturbed."""

from typing import Any, cast

from appliance.model import GatewayStatus
from appliance.plane.membership import Versions


class FakeSession:
    """Counts what is refused."""

    def __init__(self) -> None:
        self.refused: list[str] = []

    def refuse(self, what: str, **fields: Any) -> None:
        """Count it."""
        assert what == "incompatible gateway"
        self.refused.append(fields["reason"])


def status(name: str, began: int, protocol: int = 1, oldest: int = 1) -> GatewayStatus:
    """What a gateway says of itself."""
    return GatewayStatus(
        id=name, fleet="f", version=f"{protocol}.0", protocol=protocol, oldest_protocol=oldest, started_ns=began, pid=1
    )


def versions(own: GatewayStatus | None) -> tuple[Versions, FakeSession]:
    """Return what one gateway finds out."""
    session = FakeSession()
    return Versions(cast("Any", session), own=lambda: own), session


def test_one_that_comes_to_a_newer_fleet_goes() -> None:
    """Before it has told anything of itself too; the reason names both versions, and the remedy what to upgrade."""
    for own in (None, status("g2", 9)):
        found, session = versions(own)
        found.heard(status("g1", 5, protocol=3, oldest=2))
        assert found.displaced.is_set()
        assert found.problem is not None
        assert "g1 (version 3.0) speaks protocol 3" in found.problem.message
        assert "upgrade this gateway" in found.problem.remedy
        assert len(session.refused) == 1


def test_a_fleet_is_not_disturbed_by_one_that_comes() -> None:
    """Those that were there stay, and count it once for each process."""
    found, session = versions(status("g1", 5))
    for _ in range(3):
        found.heard(status("g2", 9, protocol=3, oldest=2))
    assert not found.displaced.is_set()
    assert len(session.refused) == 1
    found.heard(status("g2", 10, protocol=3, oldest=2))
    assert len(session.refused) == 2


def test_the_version_before_works_beside_this_one() -> None:
    """A newer one that says so is no reason for anything, nor is one that says nothing."""
    found, session = versions(status("g1", 5))
    found.heard(status("g2", 1, protocol=2, oldest=1))
    found.heard(GatewayStatus(id="g3", fleet="f"))
    assert not found.displaced.is_set()
    assert not session.refused
