"""The signed list of parts: what it names may be used and nothing else, whatever is done to its file."""

import contextlib
import hashlib
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError, IdentityError
from appliance.identity import parts, roster
from appliance.identity.authority import Authority
from appliance.identity.parts import ALL, InForce, Kind, Parts
from appliance.identity.roster import Roster

KEY = Ed25519PrivateKey.generate()
ONE, TWO = (hashlib.sha256(text).hexdigest() for text in (b"1", b"2"))
IMAGE = "localhost/swiftbot/base:0123456789ab"


def listed(number: int = 1, fleet: str = "yard") -> Parts:
    """Return a list with a part of each kind."""
    return Parts(fleet=fleet, number=number, image={IMAGE: (ONE,)}, skill={"goto": (ONE,)}, model={"planner": (ONE,)})


def in_force(folder: Path, data: bytes) -> InForce:
    """Return what counts for a gateway with that file, and a folder that keeps the last one."""
    (folder / parts.FILE).write_bytes(data)
    return InForce(folder / parts.FILE, authority=KEY.public_key(), fleet="yard", kept=folder / "kept.json")


@given(st.data())
def test_a_changed_list_is_refused(data: st.DataObject) -> None:
    """Cut off anywhere, or any byte of it changed, it is refused or says the very same."""
    whole = parts.seal(listed(), KEY)
    place = data.draw(st.integers(0, len(whole) - 1))
    changed = data.draw(st.sampled_from((whole[:place], whole[:place] + b"x" + whole[place + 1 :])))
    with contextlib.suppress(IdentityError):
        assert parts.unseal(changed, KEY.public_key(), "yard") == listed()


def test_only_the_fleets_authority_signs() -> None:
    """Another key, another fleet, and a signed file of another kind are refused, each with its reason."""
    other = Ed25519PrivateKey.generate()
    for data, reason in (
        (parts.seal(listed(), other), "another authority"),
        (parts.seal(listed(fleet="mill"), KEY), "of fleet mill"),
        (roster.seal(Roster(fleet="yard"), KEY), "no list of parts"),
        (parts.seal(Parts(fleet="yard", image={IMAGE: ("latest",)}), KEY), "no SHA-256"),
        (b"[" * 100_000, "damaged"),
        (b" " * (parts.MOST_BYTES + 1), "bytes"),
    ):
        with pytest.raises(IdentityError, match=reason):
            parts.unseal(data, KEY.public_key(), "yard")


def test_what_is_named_may_be_used_and_nothing_else(tmp_path: Path) -> None:
    """An image and a skill by name and digest, a model by its digest; what was refused is told until it is signed."""
    counts = in_force(tmp_path, parts.seal(listed(), KEY))
    counts.check(Kind.IMAGE, IMAGE, ONE)
    counts.check(Kind.SKILL, "goto", ONE)
    counts.check(Kind.MODEL, "another-name", ONE)
    for kind, name, digest in (
        (Kind.IMAGE, IMAGE, TWO),  # the right tag and another id
        (Kind.IMAGE, "localhost/swiftbot/base:ba9876543210", ONE),
        (Kind.SKILL, "goto", TWO),
        (Kind.SKILL, "land", ONE),  # goto's code in the place of land
        (Kind.MODEL, "planner", TWO),
    ):
        with pytest.raises(IdentityError, match="is not signed"):
            counts.check(kind, name, digest)
    assert "skill land" in counts.problem or "more" in counts.problem
    (tmp_path / parts.FILE).write_bytes(
        parts.seal(Parts(fleet="yard", number=2, skill={"goto": (ONE, TWO)}, image={IMAGE: (TWO,)}), KEY)
    )
    counts.check(Kind.SKILL, "goto", TWO)
    assert counts.text == "parts 2"
    assert counts.problem == ""


def test_without_a_list_nothing_may_be_used(tmp_path: Path) -> None:
    """A gateway with keys whose list is absent or damaged refuses everything, and takes one up once it is there."""
    counts = in_force(tmp_path, parts.seal(listed(), KEY)[:-9])
    for _ in range(2):
        with pytest.raises(IdentityError, match="damaged or cut off"):
            counts.check(Kind.SKILL, "goto", ONE)
    (tmp_path / parts.FILE).unlink()
    with pytest.raises(IdentityError, match="there is no"):
        counts.check(Kind.SKILL, "goto", ONE)
    (tmp_path / parts.FILE).write_bytes(parts.seal(listed(), KEY))
    counts.check(Kind.SKILL, "goto", ONE)
    assert not counts.problem


def test_an_older_list_is_refused_also_after_a_restart(tmp_path: Path) -> None:
    """The last one that counted is kept with the data; an older one in the file's place, or none, changes nothing."""
    counts = in_force(tmp_path, parts.seal(listed(2), KEY))
    counts.check(Kind.SKILL, "goto", ONE)
    counts.keep()
    old = parts.seal(Parts(fleet="yard", number=1, skill={"goto": (TWO,)}), KEY)
    for again in (counts, in_force(tmp_path, old)):
        (tmp_path / parts.FILE).write_bytes(old)
        with pytest.raises(IdentityError, match="not signed"):
            again.check(Kind.SKILL, "goto", TWO)
        again.check(Kind.SKILL, "goto", ONE)  # the one before still counts
        with pytest.raises(IdentityError, match="2 counts here already"):
            again.take(old)
        assert again.number == 2
    (tmp_path / parts.FILE).unlink()
    alone = InForce(tmp_path / parts.FILE, authority=KEY.public_key(), fleet="yard", kept=tmp_path / "kept.json")
    assert (alone.number, alone.problem) == (2, "")


def test_a_list_that_is_handed_on_counts_if_the_authority_signed_it(tmp_path: Path) -> None:
    """Without a file beside the keys too, and over a restart; what is not good changes nothing, and says why."""
    file, kept = tmp_path / parts.FILE, tmp_path / "kept.json"
    counts = InForce(file, authority=KEY.public_key(), fleet="yard", kept=kept)
    assert counts.number == 0
    whole = parts.seal(listed(3), KEY)
    for bad, reason in (
        (parts.seal(listed(9), Ed25519PrivateKey.generate()), "another authority"),
        (parts.seal(listed(9, fleet="mill"), KEY), "of fleet mill"),
        (whole[:-9], "damaged"),
        (b"", "damaged"),
    ):
        with pytest.raises(IdentityError, match=reason):
            counts.take(bad)
        assert counts.number == 0
    counts.take(whole)
    counts.take(whole)
    counts.check(Kind.SKILL, "goto", ONE)
    assert (counts.sealed, counts.problem) == (whole, "")
    counts.keep()
    again = InForce(file, authority=KEY.public_key(), fleet="yard", kept=kept)
    assert again.number == 3
    kept.write_bytes(b"{")  # a damaged one is as none
    assert InForce(file, authority=KEY.public_key(), fleet="yard", kept=kept).number == 0


def test_a_list_that_cannot_be_kept_is_a_problem_until_it_is(tmp_path: Path) -> None:
    """After a restart an older one would count: that is shown, and over once the disk takes it."""
    kept = tmp_path / "gone" / "kept.json"
    counts = InForce(tmp_path / parts.FILE, authority=KEY.public_key(), fleet="yard", kept=kept)
    counts.take(parts.seal(listed(3), KEY))
    counts.keep()
    assert "list 3 counts until a restart alone" in counts.problem
    kept.parent.mkdir()
    counts.keep()
    assert counts.problem == ""


def test_another_list_of_the_same_number_is_told(tmp_path: Path) -> None:
    """As by an authority that was restored from an old backup: the one that counts stays, and the remedy is named."""
    counts = in_force(tmp_path, parts.seal(listed(2), KEY))
    other = parts.seal(Parts(fleet="yard", number=2, skill={"goto": (TWO,)}), KEY)
    assert counts.number == 2
    with pytest.raises(IdentityError, match="another of its number"):
        counts.take(other)
    (tmp_path / parts.FILE).write_bytes(other)
    assert "another of its number" in counts.problem
    counts.check(Kind.SKILL, "goto", ONE)


def test_development_mode_says_so() -> None:
    """Without keys everything is allowed, and the text for people tells it."""
    ALL.check(Kind.SKILL, "goto", TWO)
    assert not ALL.checked
    assert "development mode" in ALL.text


def test_a_folders_digest_is_of_paths_bytes_and_modes(tmp_path: Path) -> None:
    """Each edit makes another one; bytecode, loops and pipes do not count; one that is not there is told."""
    folder = tmp_path / "goto"
    (folder / "data").mkdir(parents=True)
    (folder / "handler.py").write_text("def run(ctx): ...")
    (folder / "data" / "table").write_text("1")
    seen = [parts.folder_digest(folder)]
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "handler.pyc").write_text("x")
    (folder / "loop").symlink_to(folder)
    assert parts.folder_digest(folder) == seen[0]
    (folder / "data" / "table").write_text("2")
    seen.append(parts.folder_digest(folder))
    (folder / "data" / "table").chmod(0o755)
    seen.append(parts.folder_digest(folder))
    (folder / "data" / "table").rename(folder / "table")
    seen.append(parts.folder_digest(folder))
    assert len(set(seen)) == 4
    with pytest.raises(ConfigError, match="cannot be read"):
        parts.folder_digest(tmp_path / "absent")


def test_the_authority_numbers_its_lists(tmp_path: Path) -> None:
    """Each is one higher and replaces the one before; lists of several machines are signed as one."""
    authority = Authority.create(tmp_path / "authority", "yard", datetime.now(UTC))
    assert authority.sign_parts(Parts(skill={"goto": (ONE,)})).number == 1
    both = parts.together([Parts(skill={"goto": (ONE,)}), Parts(skill={"goto": (TWO,), "land": (ONE,)})])
    signed = authority.sign_parts(both, tmp_path / "copy.json")
    assert (signed.number, signed.fleet) == (2, "yard")
    assert signed.skill == {"goto": tuple(sorted((ONE, TWO))), "land": (ONE,)}
    assert (tmp_path / "copy.json").read_bytes() == (authority.folder / parts.FILE).read_bytes()
    (authority.folder / parts.FILE).write_text("{")
    with pytest.raises(IdentityError, match="damaged"):  # or its number would begin again
        authority.sign_parts(both)
