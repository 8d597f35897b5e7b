"""The authority in its folder: what it writes is whole, private where it must be, and listed."""

import fcntl
import os
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from appliance.errors import ConfigError, ConflictError, IdentityError, NotFoundError
from appliance.identity import files
from appliance.identity.authority import CERTIFICATE, KEY, ROSTER, Authority
from appliance.identity.bundle import Bundle
from appliance.model.roles import Role

NOW = datetime.now(UTC)


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    """An authority of fleet yard."""
    return Authority.create(tmp_path / "authority", "yard", NOW)


def test_private_files_are_their_owners_alone(authority: Authority, tmp_path: Path) -> None:
    """The folder, the authority's key and what is issued; certificate and roster are for everybody."""
    old = os.umask(0)
    try:
        authority.issue(Role.GATEWAY, "gw-1", out=tmp_path / "gw-1.pem")
    finally:
        os.umask(old)
    modes = {
        path.name: stat.S_IMODE(path.stat().st_mode)
        for path in (authority.folder, *authority.folder.iterdir(), tmp_path / "gw-1.pem")
    }
    assert modes == {
        "authority": 0o700,
        ".lock": 0o600,
        KEY: 0o600,
        CERTIFICATE: 0o644,
        ROSTER: 0o644,
        "gw-1.pem": 0o600,
    }


def test_what_is_issued_is_read_back(authority: Authority, tmp_path: Path) -> None:
    """Key, certificate and the authority's, in one file; it is in the roster."""
    issued = authority.issue(Role.GATEWAY, "gw-1", out=tmp_path / "gw-1.pem", hosts=("10.0.0.1",))
    read = Bundle.load(tmp_path / "gw-1.pem")
    assert read.identity == issued.identity
    assert read.certificate == issued.certificate
    assert read.authority == authority.certificate
    (entry,) = Authority.load(authority.folder).roster.issued
    assert (entry.serial, entry.hosts) == (issued.identity.serial, ("10.0.0.1",))


def test_a_name_is_given_once(authority: Authority, tmp_path: Path) -> None:
    """Within a role; it is free again when its certificate is revoked or has expired."""
    authority.issue(Role.OPERATOR, "ann", out=tmp_path / "1.pem", days=1, now=NOW)
    authority.issue(Role.VIEWER, "ann", out=tmp_path / "2.pem", now=NOW)
    with pytest.raises(ConflictError, match="keys renew operator ann"):
        authority.issue(Role.OPERATOR, "ann", out=tmp_path / "3.pem", now=NOW)
    authority.issue(Role.OPERATOR, "ann", out=tmp_path / "4.pem", now=NOW + timedelta(days=2))
    authority.revoke(Role.VIEWER, "ann", now=NOW)
    authority.issue(Role.VIEWER, "ann", out=tmp_path / "5.pem", now=NOW)
    assert not (tmp_path / "3.pem").exists()


def test_a_file_that_is_there_is_not_overwritten(authority: Authority, tmp_path: Path) -> None:
    """By `issue`; nothing is in the roster then, so the same command with another file works."""
    (tmp_path / "1.pem").write_text("mine")
    with pytest.raises(ConflictError, match="exists"):
        authority.issue(Role.OPERATOR, "ann", out=tmp_path / "1.pem")
    assert (tmp_path / "1.pem").read_text() == "mine"
    authority.issue(Role.OPERATOR, "ann", out=tmp_path / "2.pem")


def test_renewing_keeps_hosts_and_the_certificate_before(authority: Authority, tmp_path: Path) -> None:
    """A new key and certificate in the same file; the one before stays good until it expires."""
    out = tmp_path / "gw-1.pem"
    before = authority.issue(Role.GATEWAY, "gw-1", out=out, hosts=("10.0.0.1",))
    after = authority.renew(Role.GATEWAY, "gw-1", out=out)
    assert Bundle.load(out).identity == after.identity
    assert after.identity.serial != before.identity.serial
    entries = authority.roster.valid(Role.GATEWAY, "gw-1", NOW.timestamp())
    assert [each.hosts for each in entries] == [("10.0.0.1",)] * 2
    authority.roster.check(before.identity)


def test_nothing_that_is_not_there_is_renewed_or_revoked(authority: Authority, tmp_path: Path) -> None:
    """Nor renewed after it was revoked: that would undo the revocation."""
    with pytest.raises(NotFoundError, match="no certificate to renew"):
        authority.renew(Role.VIEWER, "ann", out=tmp_path / "1.pem")
    with pytest.raises(NotFoundError, match="no valid certificate"):
        authority.revoke(Role.VIEWER, "ann")
    authority.issue(Role.VIEWER, "ann", out=tmp_path / "2.pem")
    authority.revoke(Role.VIEWER, "ann")
    with pytest.raises(NotFoundError, match="it was revoked"):
        authority.renew(Role.VIEWER, "ann", out=tmp_path / "1.pem")


def test_two_commands_at_once_lose_nothing(authority: Authority, tmp_path: Path) -> None:
    """One that read the roster before another changed it takes that in; one in the middle of a change is refused."""
    other = Authority.load(authority.folder)
    authority.issue(Role.VIEWER, "ann", out=tmp_path / "1.pem")
    other.issue(Role.VIEWER, "bob", out=tmp_path / "2.pem")
    assert Authority.load(authority.folder).roster.names(Role.VIEWER, NOW.timestamp()) == ("ann", "bob")
    with (authority.folder / ".lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(ConflictError, match="another command"):
            other.revoke(Role.VIEWER, "bob")


def test_a_second_authority_does_not_replace_the_first(authority: Authority) -> None:
    """All certificates would be worth nothing."""
    with pytest.raises(ConflictError, match="has an authority already"):
        Authority.create(authority.folder, "yard", NOW)
    with pytest.raises(ConfigError, match="not a valid name"):
        Authority.create(authority.folder, "The Yard", NOW)


def test_without_an_authority_the_remedy_is_named(tmp_path: Path) -> None:
    """Nothing there, one that others may read, one that is cut off, one with the key of another."""
    with pytest.raises(IdentityError, match="swiftbot keys init"):
        Authority.load(tmp_path / "none")
    one, two = (Authority.create(tmp_path / name, "yard", NOW) for name in ("one", "two"))
    (one.folder / KEY).chmod(0o640)
    with pytest.raises(IdentityError, match="chmod 600"):
        Authority.load(one.folder)
    files.write(one.folder / KEY, (two.folder / KEY).read_bytes(), mode=0o600)
    with pytest.raises(IdentityError, match="do not belong together"):
        Authority.load(one.folder)
    files.write(one.folder / KEY, (two.folder / KEY).read_bytes()[:60], mode=0o600)
    with pytest.raises(IdentityError, match="damaged"):
        Authority.load(one.folder)


@pytest.mark.parametrize("keep", [0, 40, 150, 400, -40])
def test_a_bundle_that_is_cut_off_is_refused(authority: Authority, tmp_path: Path, keep: int) -> None:
    """Wherever it is cut; the file is named."""
    out = tmp_path / "gw-1.pem"
    authority.issue(Role.GATEWAY, "gw-1", out=out)
    out.write_bytes(out.read_bytes()[:keep])
    with pytest.raises(IdentityError, match=r"gw-1\.pem") as refused:
        Bundle.load(out)
    assert refused.value.remedy


def test_a_bundle_of_parts_of_two_is_refused(authority: Authority, tmp_path: Path) -> None:
    """The key of one with the certificate of another; one that others may read; one that is not there."""
    for name in ("a", "b"):
        authority.issue(Role.VIEWER, name, out=tmp_path / name)
    one, two = ((tmp_path / name).read_bytes().partition(b"-----BEGIN CERT") for name in ("a", "b"))
    files.write(tmp_path / "c", one[0] + two[1] + two[2], mode=0o600)
    with pytest.raises(IdentityError, match="do not belong together"):
        Bundle.load(tmp_path / "c")
    (tmp_path / "a").chmod(0o644)
    with pytest.raises(IdentityError, match="0644 lets others read it"):
        Bundle.load(tmp_path / "a")
    with pytest.raises(IdentityError, match="swiftbot keys issue"):
        Bundle.load(tmp_path / "none")


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And no temporary one."""
    target = tmp_path / "f"
    files.write(target, b"old", mode=0o600)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(IdentityError, match="No space left"):
        files.write(target, b"new", mode=0o600)
    assert target.read_bytes() == b"old"
    assert [each.name for each in tmp_path.iterdir()] == ["f"]


def test_a_folder_that_cannot_be_written_is_told_as_such(authority: Authority, tmp_path: Path) -> None:
    """A medium that is read-only or full: the error names it and the remedy, and nothing is issued."""
    (authority.folder / ".lock").unlink()
    (authority.folder / ".lock").mkdir()
    with pytest.raises(IdentityError, match="cannot be written"):
        authority.issue(Role.ROBOT, "r1", out=tmp_path / "r1.pem")
    assert authority.roster.names(Role.ROBOT, 0.0) == ()
    (tmp_path / "file").touch()
    with pytest.raises(IdentityError, match="cannot be written"):
        files.make_folder(tmp_path / "file" / "issued")
