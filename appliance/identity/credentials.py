"""The keys that one process works with: its own, and the roster by which it judges others. Both may change on disk.

Another roster counts within `LOOK_S` of being put there, if the authority signed it and its number is not lower: an old
copy brings no revoked certificate back. So do other keys of the same member, if they are good. What cannot be read is
logged and changes nothing.

Access control and certificate of a Zenoh session are those of the moment when it was opened (`Opened`). `stale` says
that they are not those of now: then the session is to be opened again (`plane.session.Session.reopen`).
"""

import contextlib
import os
import threading
import time
from pathlib import Path

import structlog
from msgspec import Struct

from appliance.errors import IdentityError
from appliance.identity import certificates, files, roster
from appliance.identity.bundle import Bundle
from appliance.identity.member import Identity
from appliance.identity.roster import Roster
from appliance.identity.signing import Signer, Verifier
from appliance.model.keys import Roles
from appliance.model.roles import Role

log = structlog.get_logger(__name__)

_PROBLEM_S = 60.0
_MOST_NAMED = 3
LOOK_S = 5.0
"""How often the roster's file is looked at; a look is one system call."""

AGAIN_S = 300.0
"""After that long a session is once more opened with what it could not be opened with: what kept it from that may have
passed, and until then a revoked robot keeps the rights of its link."""


class _Stamp(Struct, frozen=True):
    """What tells one version of a file from another."""

    inode: int
    changed_ns: int
    size: int


class OlderRosterError(IdentityError):
    """A roster is older than the one that counts."""


class Opened(Struct, frozen=True):
    """What a session was opened with."""

    bundle: Bundle
    robots: tuple[str, ...]
    """Those that are let in."""
    barred: frozenset[str] = frozenset()
    """Those whose certificates are revoked."""

    @property
    def same(self) -> tuple[str, tuple[str, ...], frozenset[str]]:
        """What two sessions have in common that need no reopening."""
        return self.bundle.identity.serial, self.robots, self.barred


class Credentials:
    """The keys of a process; made by `load`.

    Args:
        bundle: its own.
        roster_file: where the roster is, or will be.
        kept: where the one that counts is kept; None: nowhere.
    """

    def __init__(self, bundle: Bundle, roster_file: Path, kept: Path | None = None) -> None:
        self._kept = kept
        self._kept_number = 0
        self._taking = threading.Lock()
        self.sealed = b""
        """The roster as its file has it."""
        self.bundle = bundle
        self.roster_file = roster_file
        self.roster = Roster(fleet=bundle.identity.fleet)
        """Without a file: nothing is revoked, and no robot is let in."""
        self._signer = Signer(bundle.key, bundle.certificate)
        self._verifier = Verifier(bundle.authority, self.check)
        self.barred: frozenset[str] = frozenset()
        """Robots with a revoked certificate and no valid one: nothing is believed that is said in their names."""
        self._revoked: frozenset[str] = frozenset()
        """Serial numbers of what the roster has revoked: it is looked at for each request."""
        self._stamp: _Stamp | None = None
        self._keys_stamp: _Stamp | None = None
        self.opened: Opened | None = None
        """What the session was opened with last."""
        self._failed: Opened | None = None
        """What it could not be opened with."""
        self._failed_at = 0.0
        self._fall_back: Opened | None = None
        self._look_at = 0.0
        self._problem, self._problem_at = "", -_PROBLEM_S

    @classmethod
    def load(cls, keys: Path, roster_file: Path, *, fleet: str, now: float, kept: Path | None = None) -> "Credentials":
        """Read the keys of a process of a fleet, which must be good now.

        Raises:
            IdentityError: a file is absent, open to others or damaged (the roster: where the keys are a gateway's); the
                certificate is of another fleet, expired, not yet valid or revoked.
        """
        bundle = Bundle.load(keys)
        if bundle.identity.fleet != fleet:
            raise IdentityError(
                f"{keys} is of fleet {bundle.identity.fleet}, and this is fleet {fleet}",
                remedy="name the right file, or set `fleet`",
            )
        bundle.identity.check_time(now)
        found = cls(bundle, roster_file, kept)
        with contextlib.suppress(OSError):
            found._keys_stamp = _stamp(keys)
        if kept is not None and kept.exists():
            try:
                found._read(kept)
                number = found.roster.number
                found._kept_number = number
            except IdentityError as error:
                # The one of the keys' folder counts then.
                log.warning("the roster is not taken", file=str(kept), reason=str(error))
        if roster_file.exists():
            try:
                found._stamp = _stamp(roster_file)
                found._read(roster_file)
            except OlderRosterError as error:
                log.warning("the roster is not taken", file=str(roster_file), reason=str(error))
            except IdentityError as error:
                # Only gateways judge others by it: a damaged copy must not keep an operator from a soft stop.
                if bundle.identity.role is Role.GATEWAY:
                    raise
                log.warning("the roster is not taken", file=str(roster_file), reason=str(error))
            found.roster.check(bundle.identity)
        return found

    @property
    def identity(self) -> Identity:
        """Who this process is."""
        return self.bundle.identity

    def check_role(self, roles: Roles, what: str) -> None:
        """Raise IdentityError unless this process is of one of these roles. `what`: what it is about to do."""
        _check_role(self.identity, roles, what)

    def check_listener(self, gateway: str) -> None:
        """Raise IdentityError unless these keys may accept links: a gateway's, and of that id if one is given."""
        if not gateway and self.identity.role is not Role.GATEWAY:
            raise IdentityError(
                f"{self.bundle.path} is of {self.identity.text}, and only gateways accept links",
                remedy="swiftbot keys issue gateway NAME --host ADDRESS",
            )
        if gateway and (self.identity.role, self.identity.name) != (Role.GATEWAY, gateway):
            raise IdentityError(
                f"{self.bundle.path} is of {self.identity.text}, and this is gateway {gateway}",
                remedy=f"swiftbot keys issue gateway {gateway}, or set `id`",
            )

    def robots(self) -> tuple[str, ...]:
        """The robots that have a valid certificate."""
        return self.roster.names(Role.ROBOT, time.time())

    def open(self) -> Opened:
        """What a session is opened with now."""
        self.opened = self._fall_back or self._now()
        self._fall_back = None
        return self.opened

    def fall_back(self, before: Opened) -> None:
        """Have the next session opened as one was before: with what there is now none could be."""
        self._failed, self._failed_at, self._fall_back = self._now(), time.monotonic(), before

    @property
    def stale(self) -> bool:
        """Whether the session was opened with other keys, or for other robots, than there are now.

        Not for `AGAIN_S` after it could not be opened with these.
        """
        now = self._now()
        failed = self._failed is not None and self._failed.same == now.same
        failed = failed and time.monotonic() - self._failed_at < AGAIN_S
        return self.opened is not None and self.opened.same != now.same and not failed

    def _now(self) -> Opened:
        return Opened(self.bundle, self.robots(), self.barred)

    def refresh(self) -> bool:
        """Look whether there is another roster, at most every `LOOK_S`; returns whether another counts from now on.

        Other keys of this process are taken up too.
        """
        now = time.monotonic()
        if now < self._look_at:
            return False
        self._look_at = now + LOOK_S
        before = self.roster.number
        self._look_at_roster()
        self._look_at_keys()
        return self.roster.number != before

    def _look_at_roster(self) -> None:
        """Take up another roster, where its file has one."""
        with contextlib.suppress(OSError):
            if (stamp := _stamp(self.roster_file)) == self._stamp:
                return
            self._stamp = stamp
            try:
                self._read(self.roster_file)
            except IdentityError as error:
                log.warning("the roster is not taken", file=str(self.roster_file), reason=str(error))

    def check(self, identity: Identity, now: float) -> None:
        """Raise IdentityError unless a certificate that the authority signed is good at a moment (Unix seconds)."""
        identity.check_time(now)
        self.refresh()
        if identity.serial in self._revoked:
            self.roster.check(identity)

    def problem(self, now: float) -> str:
        """What is to be done about keys soon: this process's own, and those that the roster has; empty when nothing is.

        Args:
            now: Unix seconds; it is looked again once a minute.
        """
        if 0 <= now - self._problem_at < _PROBLEM_S:
            return self._problem
        self._problem_at = now
        self.refresh()
        self._problem = expiry_text(self.identity, self.roster, now, listed=self.roster.number > 0)
        return self._problem

    def sign(self, key: str, payload: bytes) -> bytes:
        """Sign a request of this process for a key, made now."""
        return self._signer.sign(key, payload, time.time_ns())

    def verify(self, signature: bytes, key: str, payload: bytes, *, roles: Roles) -> Identity:
        """Return who signed a request that has come for a key; of `roles` there must be one.

        Raises:
            IdentityError: as of `Verifier.verify`, or it is of another role.
        """
        identity = self._verifier.verify(signature, key, payload, now=time.time(), clock_s=time.monotonic())
        try:
            _check_role(identity, roles, f"ask {key}")
        except IdentityError as error:
            error.sender = identity.name
            raise
        return identity

    def keep(self) -> None:
        """Have the roster that counts on the disk, where it is to be kept; blocks."""
        number, kept = self.roster.number, self._kept
        if kept is None or number <= self._kept_number:
            return
        try:
            files.write(kept, self.sealed, mode=files.PUBLIC)
            self._kept_number = number
        except IdentityError as error:
            log.warning("the roster cannot be kept", file=str(kept), reason=str(error))

    def _look_at_keys(self) -> None:
        """Take up other keys of this process, where its file has others that are good."""
        path = self.bundle.path
        with contextlib.suppress(OSError):
            if (stamp := _stamp(path)) == self._keys_stamp:
                return
            self._keys_stamp = stamp
            try:
                bundle = Bundle.load(path)
                self._check_next(bundle)
            except IdentityError as error:
                log.warning("the keys are not taken", file=str(path), reason=str(error))
                return
            if bundle.identity.serial != self.identity.serial:
                self.bundle, self._signer = bundle, Signer(bundle.key, bundle.certificate)
                self._problem_at = -_PROBLEM_S
                log.info("the keys are new", member=bundle.identity.text, serial=bundle.identity.serial[-8:])

    def _check_next(self, bundle: Bundle) -> None:
        """Raise IdentityError unless keys can take the place of these."""
        if bundle.authority != self.bundle.authority:
            raise IdentityError("another authority made them", remedy="restart with them, if the authority is another")
        if bundle.identity.text != self.identity.text:
            raise IdentityError(f"they are of {bundle.identity.text}, and this is {self.identity.text}")
        bundle.identity.check_time(time.time())
        self.roster.check(bundle.identity)

    def _read(self, path: Path) -> None:
        self.take(files.read(path, private=False, absent="copy it from the authority", most=roster.MOST_BYTES))

    @property
    def number(self) -> int:
        """Of the roster that counts."""
        return self.roster.number

    def take(self, sealed: bytes) -> None:
        """Go by a roster, as its file has it.

        Raises:
            OlderRosterError: it is older than the one that counts.
            IdentityError: it is damaged, of another fleet, or another authority signed it.
        """
        found = roster.unseal(sealed, certificates.ed25519_of(self.bundle.authority), self.identity.fleet)
        revoked = frozenset(each.serial for each in found.issued if each.revoked)
        robots = {each.name for each in found.issued if each.role is Role.ROBOT and each.revoked}
        barred = frozenset(robots.difference(found.names(Role.ROBOT, time.time())))
        # It comes on several threads: of two the newer stays, and its number shows last, when all else of it counts.
        with self._taking:
            if found.number < self.roster.number:
                raise OlderRosterError(
                    f"its number is {found.number}, and {self.roster.number} counts already",
                    remedy="copy the newest from the authority",
                )
            self.sealed, self._revoked, self.barred = sealed, revoked, barred
            self.roster = found


def expiry_text(own: Identity, listed_in: Roster, now: float, *, listed: bool) -> str:
    """What is to be done about keys soon, in words; empty when nothing is.

    Args:
        own: whose process it is.
        listed_in: the roster.
        now: Unix seconds.
        listed: whether there is a roster.
    """
    said: list[str] = []
    if (days := own.days_left(now)) < certificates.WARN_DAYS:
        said.append(f"its certificate expires in {days:.0f} days" if days > 0 else "its certificate has expired")
    latest: dict[tuple[Role, str], float] = {}
    for each in listed_in.issued:
        if not each.revoked:
            member = each.role, each.name
            latest[member] = max(latest.get(member, 0.0), each.not_after)
    soon = sorted(
        (end, f"{role} {name}")
        for (role, name), end in latest.items()
        if now < end < now + certificates.WARN_DAYS * 86_400 and (role, name) != (own.role, own.name)
    )
    if soon:
        more = f" and {len(soon) - _MOST_NAMED} more" if len(soon) > _MOST_NAMED else ""
        names = ", ".join(name for _, name in soon[:_MOST_NAMED])
        said.append(f"certificates that expire within {certificates.WARN_DAYS} days: {names}{more}")
    if not listed:
        said.append("it has no roster: no robot is let in, and no certificate counts as revoked")
    return "; ".join(said)


def _check_role(identity: Identity, roles: Roles, what: str) -> None:
    if identity.role not in roles:
        able = ", ".join(sorted(roles - {Role.GATEWAY})) or "nobody but gateways"
        raise IdentityError(f"{identity.text} may not {what}", remedy=f"who may: {able}")


def _stamp(path: Path) -> _Stamp:
    about = os.stat(path)  # noqa: PTH116 - one call, often
    return _Stamp(about.st_ino, about.st_mtime_ns, about.st_size)
