"""The fleet's authority: a folder with its private key, its certificate and the roster; issues, renews and revokes.

The private key makes its holder any gateway or operator. The folder belongs on a machine that is no
gateway, or on a stick in a safe: gateways need only what it has issued.
"""

import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from msgspec.structs import replace

from appliance.errors import ConfigError, ConflictError, IdentityError, NotFoundError, PayloadError
from appliance.identity import certificates, files, parts, roster
from appliance.identity.bundle import Bundle, private_text
from appliance.identity.parts import Parts
from appliance.identity.roster import Issued, Roster
from appliance.model.keys import check_name
from appliance.model.roles import Role

KEY, CERTIFICATE, ROSTER = "authority.key", "authority.crt", "roster.json"


def default_folder(fleet: str) -> Path:
    """Where an authority is kept when nothing else is said: below XDG_CONFIG_HOME."""
    home = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(home) / "swiftbot" / "authority" / fleet


class Authority:
    """The authority in a folder; made by `create` or `load`."""

    def __init__(self, folder: Path, key: Ed25519PrivateKey, certificate: x509.Certificate, listed: Roster) -> None:
        self.folder = folder
        self.certificate = certificate
        self.roster = listed
        self._key = key

    @property
    def fleet(self) -> str:
        """The fleet that it is of."""
        return certificates.fleet_of(self.certificate)

    @property
    def roster_file(self) -> Path:
        """Where the signed roster is, which every gateway needs a copy of."""
        return self.folder / ROSTER

    @classmethod
    def create(cls, folder: Path, fleet: str, now: datetime) -> "Authority":
        """Make a fleet's authority.

        Raises:
            ConfigError: the fleet's name is none.
            ConflictError: the folder has one already.
            IdentityError: it cannot be written.
        """
        try:
            check_name(fleet, "fleet")
        except PayloadError as error:
            raise ConfigError(error.message, remedy=error.remedy) from error
        if len(fleet) > certificates.MOST_COMMON_NAME:
            raise ConfigError(f"fleet {fleet!r} is too long for a certificate")
        try:
            folder.mkdir(mode=files.FOLDER, parents=True, exist_ok=True)
            folder.chmod(files.FOLDER)
        except OSError as error:
            raise IdentityError(
                f"{folder} cannot be made: {error.strerror}", remedy="name another folder with --authority"
            ) from error
        with files.locked(folder):
            if (folder / KEY).exists():
                raise ConflictError(
                    f"{folder} has an authority already",
                    remedy="all that it has issued would be worth nothing; move it away if that is meant",
                )
            key = Ed25519PrivateKey.generate()
            made = cls(folder, key, certificates.make_authority(fleet, key, now), Roster(fleet=fleet))
            files.write(made.roster_file, roster.seal(made.roster, key), mode=files.PUBLIC)
            files.write(
                folder / CERTIFICATE, made.certificate.public_bytes(serialization.Encoding.PEM), mode=files.PUBLIC
            )
            # Last: without it there is no authority yet, and `create` may be run again after a power cut.
            files.write(folder / KEY, private_text(key), mode=files.PRIVATE, replace=False)
        return made

    @classmethod
    def load(cls, folder: Path) -> "Authority":
        """Read a fleet's authority.

        Raises:
            IdentityError: there is none, or a file of it is open to others, damaged, or of another authority.
        """
        absent = "swiftbot keys init makes an authority; --authority names the folder of one"
        text = files.read(folder / KEY, private=True, absent=absent)
        try:
            key = serialization.load_pem_private_key(text, password=None)
            certificate = x509.load_pem_x509_certificate(
                files.read(folder / CERTIFICATE, private=False, absent="copy it back from a backup")
            )
        except (ValueError, TypeError, x509.InvalidVersion) as error:
            raise IdentityError(
                f"the authority in {folder} is damaged: {error}", remedy="copy it back from a backup"
            ) from None
        if not isinstance(key, Ed25519PrivateKey) or key.public_key() != certificates.ed25519_of(certificate):
            raise IdentityError(
                f"{folder}: {KEY} and {CERTIFICATE} do not belong together", remedy="copy both back from a backup"
            )
        sealed = files.read(folder / ROSTER, private=False, absent="copy it back from a backup", most=roster.MOST_BYTES)
        return cls(
            folder, key, certificate, roster.unseal(sealed, key.public_key(), certificates.fleet_of(certificate))
        )

    def issue(
        self,
        role: Role,
        name: str,
        *,
        out: Path,
        hosts: Sequence[str] = (),
        days: int = 0,
        now: datetime | None = None,
    ) -> Bundle:
        """Make a new member's private key and certificate.

        Args:
            role: What it may do.
            name: Its name, unique within its role.
            out: The file to write, which must not exist.
            hosts: Under which names and addresses a gateway is dialled.
            days: How long it is good; 0: as is usual for the role.
            now: When that is.

        Raises:
            ConflictError: the name is taken, or the file exists.
            ConfigError: a name, host or number of days cannot be.
            IdentityError: a file cannot be written.
        """
        at = now or datetime.now(UTC)
        certificates.check_member(role, name)
        with files.locked(self.folder):
            self._reload()
            if valid := self.roster.valid(role, name, at.timestamp()):
                raise ConflictError(
                    f"{role} {name} has a certificate, {valid[-1].serial[-8:]}",
                    remedy=f"swiftbot keys renew {role} {name}, or revoke it first",
                )
            return self._issue(role, name, out=out, hosts=hosts, days=days, now=at, replace=False)

    def renew(
        self,
        role: Role,
        name: str,
        *,
        out: Path,
        hosts: Sequence[str] = (),
        days: int = 0,
        now: datetime | None = None,
    ) -> Bundle:
        """Make a member another private key and certificate; the one before stays good until it expires.

        Args and errors as of `issue`, but the file may exist, and without `hosts` the last ones are kept.

        Raises:
            NotFoundError: it has none, or the last one was revoked.
        """
        at = now or datetime.now(UTC)
        with files.locked(self.folder):
            self._reload()
            before = [each for each in self.roster.issued if (each.role, each.name) == (role, name)]
            if not before or before[-1].revoked:
                raise NotFoundError(
                    f"{role} {name} has no certificate to renew" + (": it was revoked" if before else ""),
                    remedy=f"swiftbot keys issue {role} {name}",
                )
            return self._issue(
                role, name, out=out, hosts=tuple(hosts) or before[-1].hosts, days=days, now=at, replace=True
            )

    def revoke(self, role: Role, name: str, *, why: str = "", now: datetime | None = None) -> tuple[Issued, ...]:
        """Take all certificates of a member back; returns which. NotFoundError when it has no valid one."""
        at = (now or datetime.now(UTC)).timestamp()
        with files.locked(self.folder):
            self._reload()
            valid = self.roster.valid(role, name, at)
            if not valid:
                raise NotFoundError(f"{role} {name} has no valid certificate", remedy="swiftbot keys list shows all")
            self._keep(self.roster.revoke(role, name, now=at, why=why))
            return tuple(each for each in self.roster.issued if each.serial in {one.serial for one in valid})

    def sign_parts(self, listed: Parts, out: Path | None = None, now: datetime | None = None) -> Parts:
        """Sign the fleet's next list of parts, in place of the one before; returns it with its number.

        Args:
            listed: the parts.
            out: a file to write it to as well.
            now: when that is.

        Raises:
            IdentityError: the one before is damaged, or a file cannot be written.
        """
        file = self.folder / parts.FILE
        with files.locked(self.folder):
            before = parts.unseal(parts.read(file), self._key.public_key(), self.fleet) if file.exists() else Parts()
            signed = (now or datetime.now(UTC)).timestamp()
            made = replace(listed, fleet=self.fleet, number=before.number + 1, signed=signed)
            data = parts.seal(made, self._key)
            files.write(file, data, mode=files.PUBLIC)
            if out is not None:
                files.write(out, data, mode=files.PUBLIC)
        return made

    def _issue(
        self, role: Role, name: str, *, out: Path, hosts: Sequence[str], days: int, now: datetime, replace: bool
    ) -> Bundle:
        key = Ed25519PrivateKey.generate()
        made = certificates.make_certificate(
            self.certificate,
            self._key,
            key.public_key(),
            role=role,
            name=name,
            hosts=hosts,
            days=days or certificates.DAYS[role],
            now=now,
        )
        identity = certificates.identify(made, self.certificate)
        bundle = Bundle(path=out, key=key, certificate=made, authority=self.certificate, identity=identity)
        if not replace and out.exists():
            raise ConflictError(f"{out} exists", remedy="remove it, or name another file with --out")
        # Before the file: a certificate that the roster lacks could not be revoked.
        self._keep(
            self.roster.add(
                Issued(
                    role=role,
                    name=name,
                    serial=identity.serial,
                    not_after=identity.not_after,
                    issued=now.timestamp(),
                    hosts=certificates.hosts_of(made),
                )
            )
        )
        files.write(out, bundle.text(), mode=files.PRIVATE, replace=replace)
        return bundle

    def _reload(self) -> None:
        """Take in what another command has changed since this one read it."""
        self.roster = Authority.load(self.folder).roster

    def _keep(self, changed: Roster) -> None:
        files.write(self.roster_file, roster.seal(changed, self._key), mode=files.PUBLIC)
        self.roster = changed
