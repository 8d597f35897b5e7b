"""The keys of a process: good ones are taken, a new roster counts, and what runs out soon is told."""

import shutil
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from appliance.errors import IdentityError
from appliance.identity import credentials as module
from appliance.identity.authority import Authority
from appliance.identity.credentials import Credentials, OlderRosterError, expiry_text
from appliance.identity.member import Identity
from appliance.identity.roster import Issued, Roster
from appliance.model.roles import Role

DAY = 86_400.0
OWN = Identity(fleet="f", role=Role.GATEWAY, name="gw-1", serial="1", not_before=0.0, not_after=100 * DAY)


class Place:
    """An authority, and the folder of a gateway that it has issued keys for."""

    def __init__(self, folder: Path) -> None:
        self.now = datetime.now(UTC)
        self.authority = Authority.create(folder / "authority", "f", self.now)
        self.keys = folder / "gw-1.pem"
        self.roster = folder / "roster.json"
        self.authority.issue(Role.GATEWAY, "gw-1", out=self.keys)

    def load(self, *, after: timedelta = timedelta(), fleet: str = "f") -> Credentials:
        """Read the keys."""
        return Credentials.load(self.keys, self.roster, fleet=fleet, now=(self.now + after).timestamp())


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """Return one where rosters are looked at whenever asked."""
    monkeypatch.setattr(module, "LOOK_S", 0.0)
    return Place(tmp_path)


def test_keys_that_are_not_good_are_refused(place: Place) -> None:
    """Expired, of another fleet, or those of another gateway."""
    place.load().check_listener("gw-1")
    with pytest.raises(IdentityError, match="expired"):
        place.load(after=timedelta(days=400))
    with pytest.raises(IdentityError, match="is of fleet f, and this is fleet dock"):
        place.load(fleet="dock")
    with pytest.raises(IdentityError, match="this is gateway gw-2"):
        place.load().check_listener("gw-2")


def test_another_roster_counts_once_it_is_there(place: Place) -> None:
    """Robots come with it; one with a lower number, a damaged one and another authority's change nothing."""
    it = place.load()
    assert (it.roster.number, it.robots()) == (0, ())
    shutil.copy(place.authority.roster_file, place.roster)
    older = place.roster.read_bytes()
    assert it.refresh()
    assert not it.refresh()
    place.authority.issue(Role.ROBOT, "r1", out=place.roster.with_name("r1.pem"))
    shutil.copy(place.authority.roster_file, place.roster)
    assert it.refresh()
    assert it.robots() == ("r1",)
    for wrong in (older, b"", b"{}", older[:100]):
        place.roster.write_bytes(wrong)
        assert not it.refresh()
        assert it.robots() == ("r1",)
    place.roster.unlink()
    assert not it.refresh()
    assert it.robots() == ("r1",)


def test_the_number_of_a_roster_shows_when_all_of_it_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that looks meanwhile sees no new number without its revoked robots: it would never stop them."""
    authority, credentials = _renewed(tmp_path)
    authority.revoke(Role.ROBOT, "drone_1")
    before, seen, names = credentials.roster.number, list[int](), Roster.names

    def look(of: Roster, role: Role, now: float) -> tuple[str, ...]:
        seen.append(credentials.roster.number)
        return names(of, role, now)

    monkeypatch.setattr(Roster, "names", look)
    credentials.take(authority.roster_file.read_bytes())
    assert set(seen) == {before}
    assert credentials.roster.number == before + 1
    assert credentials.barred == {"drone_1"}


def test_of_two_rosters_that_come_at_once_the_newer_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the older one was being taken already when the newer one came."""
    authority, credentials = _renewed(tmp_path)
    authority.issue(Role.ROBOT, "drone_2", out=tmp_path / "drone_2.pem")
    older = authority.roster_file.read_bytes()
    authority.revoke(Role.ROBOT, "drone_2")
    newer, names, came = authority.roster_file.read_bytes(), Roster.names, list[bool]()

    def overtake(of: Roster, role: Role, now: float) -> tuple[str, ...]:
        if not came:
            came.append(True)
            credentials.take(newer)
        return names(of, role, now)

    monkeypatch.setattr(Roster, "names", overtake)
    with pytest.raises(OlderRosterError):
        credentials.take(older)
    assert credentials.sealed == newer
    assert credentials.barred == {"drone_2"}


def test_a_revoked_process_does_not_start(place: Place) -> None:
    """Where its roster says so."""
    place.authority.revoke(Role.GATEWAY, "gw-1", why="stolen")
    shutil.copy(place.authority.roster_file, place.roster)
    with pytest.raises(IdentityError, match="stolen"):
        place.load()


def test_a_damaged_roster_keeps_no_person_out(place: Place) -> None:
    """Nor from a soft stop; a gateway, which judges others by it, does not start."""
    operator = place.keys.with_name("ann.pem")
    place.authority.issue(Role.OPERATOR, "ann", out=operator)
    place.roster.write_bytes(place.authority.roster_file.read_bytes()[:100])
    found = Credentials.load(operator, place.roster, fleet="f", now=place.now.timestamp())
    assert found.identity.name == "ann"
    with pytest.raises(IdentityError, match="damaged"):
        place.load()


def listed(*ends: tuple[str, float]) -> Roster:
    """Return a roster of robots with the ends of their certificates."""
    issued = tuple(Issued(role=Role.ROBOT, name=name, serial=f"{at}", not_after=at, issued=0.0) for name, at in ends)
    return Roster(fleet="f", number=1, issued=issued)


@pytest.mark.parametrize(
    ("now", "ends", "said"),
    [
        (0.0, (), ""),
        (90 * DAY, (), "its certificate expires in 10 days"),
        (100 * DAY, (), "its certificate has expired"),
        (0.0, (("a", 10 * DAY),), "certificates that expire within 21 days: robot a"),
        (0.0, (("a", 10 * DAY), ("a", 200 * DAY)), ""),
        (0.0, (("a", 30 * DAY), ("b", -DAY)), ""),
        (
            0.0,
            tuple((name, (ord(name) - 90) * DAY) for name in "edcba"),
            "certificates that expire within 21 days: robot a, robot b, robot c and 2 more",
        ),
    ],
)
def test_what_runs_out_soon_is_told(now: float, ends: tuple[tuple[str, float], ...], said: str) -> None:
    """One's own and others', unless a later one was issued; what has expired long since is nobody's concern."""
    assert expiry_text(OWN, listed(*ends), now, listed=True) == said


def test_a_gateway_without_a_roster_says_so() -> None:
    """It lets no robot in."""
    assert "no roster" in expiry_text(OWN, Roster(fleet="f"), 0.0, listed=False)


def _renewed(folder: Path, name: str = "gw-1") -> tuple[Authority, Credentials]:
    """Return an authority and the credentials of a gateway that has opened its session with them."""
    authority = Authority.create(folder / "authority", "yard", datetime.now(UTC))
    keys = folder / "gateway.pem"
    authority.issue(Role.GATEWAY, name, out=keys)
    authority.issue(Role.ROBOT, "drone_1", out=folder / "drone.pem")
    credentials = Credentials.load(keys, authority.roster_file, fleet="yard", now=time.time())
    credentials.open()
    return authority, credentials


def _look(credentials: Credentials) -> None:
    credentials._look_at = 0.0
    credentials.refresh()


def test_renewed_keys_are_taken_up_and_make_the_session_stale(tmp_path: Path) -> None:
    """What is signed from then on is signed with them, and the session is to be opened again."""
    authority, credentials = _renewed(tmp_path)
    assert not credentials.stale
    authority.renew(Role.GATEWAY, "gw-1", out=credentials.bundle.path)
    _look(credentials)
    assert credentials.identity.serial == authority.roster.valid(Role.GATEWAY, "gw-1", 0)[-1].serial
    assert credentials.verify(credentials.sign("a", b"b"), "a", b"b", roles=frozenset({Role.GATEWAY})).name == "gw-1"
    assert credentials.stale
    credentials.open()
    assert not credentials.stale


@pytest.mark.parametrize("bad", ["another member", "another authority", "cut off", "revoked", "open to others"])
def test_keys_that_cannot_take_the_place_of_the_ones_before_do_not(tmp_path: Path, bad: str) -> None:
    """The process goes on with what it has, and its session is not opened again."""
    authority, credentials = _renewed(tmp_path)
    before, path = credentials.identity.serial, credentials.bundle.path
    out = tmp_path / "next.pem"
    if bad == "another authority":
        Authority.create(tmp_path / "other", "yard", datetime.now(UTC)).issue(Role.GATEWAY, "gw-1", out=out)
    elif bad == "another member":
        authority.issue(Role.GATEWAY, "gw-2", out=out)
    else:
        authority.renew(Role.GATEWAY, "gw-1", out=out)
    if bad == "cut off":
        out.write_bytes(out.read_bytes()[:200])
    elif bad == "revoked":
        authority.revoke(Role.GATEWAY, "gw-1")
    elif bad == "open to others":
        out.chmod(0o644)
    out.replace(path)
    _look(credentials)
    assert credentials.identity.serial == before
    assert not credentials.stale


def test_other_robots_make_the_session_stale(tmp_path: Path) -> None:
    """One that is new, and one that is revoked; not one of which nothing has changed, nor an operator."""
    authority, credentials = _renewed(tmp_path)
    authority.issue(Role.OPERATOR, "ann", out=tmp_path / "ann.pem")
    _look(credentials)
    assert not credentials.stale
    authority.issue(Role.ROBOT, "drone_2", out=tmp_path / "drone_2.pem")
    _look(credentials)
    assert credentials.stale
    credentials.open()
    authority.revoke(Role.ROBOT, "drone_1")
    _look(credentials)
    assert credentials.stale
    assert credentials.open().robots == ("drone_2",)


def test_what_could_not_be_opened_is_tried_again_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What kept the session from it may have passed: otherwise a revoked robot would keep its rights for good."""
    authority, credentials = _renewed(tmp_path)
    before = credentials.opened
    assert before is not None
    authority.revoke(Role.ROBOT, "drone_1")
    _look(credentials)
    credentials.open()
    credentials.fall_back(before)
    assert credentials.open().robots == ("drone_1",)
    assert not credentials.stale
    later = time.monotonic() + module.AGAIN_S
    monkeypatch.setattr(time, "monotonic", lambda: later)
    assert credentials.stale
    assert credentials.open().robots == ()
    assert not credentials.stale


def test_what_could_not_be_opened_is_not_tried_again_at_once(tmp_path: Path) -> None:
    """The session goes back to what it had; another change is tried once more."""
    authority, credentials = _renewed(tmp_path)
    before = credentials.opened
    assert before is not None
    authority.issue(Role.ROBOT, "drone_2", out=tmp_path / "drone_2.pem")
    _look(credentials)
    credentials.open()
    credentials.fall_back(before)
    assert credentials.open() == before
    assert not credentials.stale
    authority.issue(Role.ROBOT, "drone_3", out=tmp_path / "drone_3.pem")
    _look(credentials)
    assert credentials.stale
