"""Bundles: what a trusted key has signed is taken out whole; anything else is refused before it counts."""

import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance import durable
from appliance.deploy import bundle as bundles
from appliance.errors import ConfigError, ConflictError, IdentityError, PayloadError, RefusedError, SwiftbotError

FILES = {
    "wheels/swiftbot-2.0.0-py3-none-any.whl": b"program",
    "wheels/other-1.0-py3-none-any.whl": bytes(range(256)) * 20,
    "systemd/swiftbot-gateway.service": b"[Unit]\n",
    "images/base.tar": b"i" * 5000,
    "LICENSE": b"free",
}


@pytest.mark.parametrize("path", [".", "/", "/dev/null/a.key"])
def test_a_key_is_made_only_where_a_file_can_be(path: str) -> None:
    """A folder, or what is below a file, is refused with the reason."""
    with pytest.raises(ConfigError, match=r"cannot be written: (Is|Not) a directory"):
        bundles.make_key(Path(path))


@pytest.fixture
def key() -> Ed25519PrivateKey:
    """A key that signs."""
    return Ed25519PrivateKey.generate()


def make(folder: Path, key: Ed25519PrivateKey, **changed: str) -> Path:
    """Make a bundle."""
    for name, content in FILES.items():
        path = folder / "files" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    said = {"release": "2.0.0+abc", "version": "2.0.0", "architecture": "x86_64"} | changed
    out = folder / "swiftbot.bundle"
    bundles.pack(folder / "files", out, key, made=1.8e9, **said)
    return out


def taken_out(path: Path, key: Ed25519PrivateKey, folder: Path) -> dict[str, bytes]:
    """What comes out of a bundle."""
    with bundles.opened(path, (Ed25519PrivateKey.generate().public_key(), key.public_key())) as bundle:
        bundle.check_for(architecture="x86_64", python=bundle.manifest.python, running="1.0.0", older=False)
        bundle.take_out(folder)
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_what_goes_in_comes_out(tmp_path: Path, key: Ed25519PrivateKey) -> None:
    """Signed by one of the trusted keys, every file as it was; the same folder and time make the same bytes."""
    path = make(tmp_path, key)
    assert taken_out(path, key, tmp_path / "out") == FILES
    assert bundles.release_in(path) == "2.0.0+abc"
    first = path.read_bytes()
    assert make(tmp_path, key).read_bytes() == first


def test_cut_off_anywhere_it_is_refused(tmp_path: Path, key: Ed25519PrivateKey) -> None:
    """At every 512th byte, and in the last block: an error that says so, never a half release."""
    path = make(tmp_path, key)
    whole = path.read_bytes()
    end = max(index for index, byte in enumerate(whole) if byte) + 1
    for number, cut in enumerate([*range(0, end, 512), end - 1]):
        path.write_bytes(whole[:cut])
        with pytest.raises(PayloadError, match=r"cut off|no bundle|the file ends before"):
            taken_out(path, key, tmp_path / f"out-{number}")


def test_changed_anywhere_it_is_refused(tmp_path: Path, key: Ed25519PrivateKey) -> None:
    """One changed byte of manifest, signature or any member is found."""
    path = make(tmp_path, key)
    whole = path.read_bytes()
    with tarfile.open(path) as tar:
        places = [(each.offset_data, each.size) for each in tar.getmembers()]
    for number, (offset, size) in enumerate(places):
        for at in {offset, offset + size // 2, offset + size - 1}:
            path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
            with pytest.raises((PayloadError, IdentityError)):
                taken_out(path, key, tmp_path / f"out-{number}-{at}")


def test_another_key_is_refused(tmp_path: Path, key: Ed25519PrivateKey) -> None:
    """A good bundle of a stranger is none; the error says where trusted keys are."""
    with pytest.raises(IdentityError, match="not signed by a key that this machine trusts") as caught:
        taken_out(make(tmp_path, Ed25519PrivateKey.generate()), key, tmp_path / "out")
    assert "release.pub" in caught.value.remedy


@pytest.mark.parametrize(
    ("changed", "python", "running", "said"),
    [
        ({"architecture": "aarch64"}, "", "1.0.0", "is for aarch64, and this machine is x86_64"),
        ({}, "2.7", "1.0.0", "and this machine has 2.7"),
        ({}, "", "2.0.1", "older than 2.0.1"),
        ({"version": "2.0.0rc1"}, "", "2.0.0", "older than 2.0.0"),
    ],
)
def test_not_for_this_machine(
    tmp_path: Path, key: Ed25519PrivateKey, changed: dict[str, str], python: str, running: str, said: str
) -> None:
    """Another architecture, another Python, an older version: refused with the reason and what to do."""
    path = make(tmp_path, key, **changed)
    with bundles.opened(path, (key.public_key(),)) as bundle:
        python = python or bundle.manifest.python
        with pytest.raises(RefusedError, match=said) as caught:
            bundle.check_for(architecture="x86_64", python=python, running=running, older=False)
        assert caught.value.remedy


def test_older_is_installed_when_asked_for(tmp_path: Path, key: Ed25519PrivateKey) -> None:
    """--older, and another build of the same version, are no downgrade."""
    with bundles.opened(make(tmp_path, key), (key.public_key(),)) as bundle:
        python = bundle.manifest.python
        bundle.check_for(architecture="x86_64", python=python, running="3.0", older=True)
        bundle.check_for(architecture="x86_64", python=python, running="2.0.0+zzz", older=False)
        bundle.check_for(architecture="x86_64", python=python, running="", older=False)


Change = Callable[[bundles.Manifest], bundles.Manifest]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("../../etc/cron.d/x", "belongs in no bundle"),
        ("/etc/passwd", "belongs in no bundle"),
        ("wheels/../../x", "belongs in no bundle"),
        ("other/x", "belongs in no bundle"),
        ("wheels//x", "belongs in no bundle"),
    ],
)
def test_names_that_lead_elsewhere(tmp_path: Path, key: Ed25519PrivateKey, name: str, said: str) -> None:
    """A signed manifest too may name only files below the bundle's own folders."""
    member = bundles.Member(name=name, size=0, sha256="")
    manifest = bundles.Manifest(
        release="r", version="1", architecture="x86_64", python="3.11", made=0.0, members=(member,)
    )
    text = msgspec.json.encode(manifest)
    path = tmp_path / "bundle"
    with tarfile.open(path, "w") as tar:
        for entry, content in (("bundle.json", text), ("bundle.sig", key.sign(bundles.SIGNED_AS + text))):
            info = tarfile.TarInfo(entry)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    with pytest.raises(PayloadError, match=said), bundles.opened(path, (key.public_key(),)):
        pass


def test_links_and_strange_files_are_not_packed(tmp_path: Path, key: Ed25519PrivateKey) -> None:
    """A folder with a link, with something else, or without the program makes no bundle."""
    make(tmp_path, key)
    (tmp_path / "files/wheels/link").symlink_to("/etc/passwd")
    with pytest.raises(ConfigError, match="belongs in no bundle"):
        make(tmp_path, key)
    (tmp_path / "files/wheels/link").unlink()
    (tmp_path / "files/strange").write_text("")
    with pytest.raises(ConfigError, match="belongs in no bundle"):
        make(tmp_path, key)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no wheel of the program"):
        bundles.pack(tmp_path / "empty", tmp_path / "x", key, release="r", version="1", architecture="x86_64", made=0.0)
    assert list(tmp_path.glob(f".*{durable.NEW}")) == []


def test_keys(tmp_path: Path) -> None:
    """A key is made once, private to its owner; one that others may read signs nothing; trusted ones may be several."""
    public = bundles.make_key(tmp_path / "key")
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    with pytest.raises(ConflictError, match="exists"):
        bundles.make_key(tmp_path / "key")
    second = bundles.make_key(tmp_path / "second")
    trusted = tmp_path / "release.pub"
    trusted.write_bytes(b"# ours\n" + public.read_bytes() + second.read_bytes())
    assert len(bundles.load_trusted(trusted)) == 2
    assert bundles.load_key(tmp_path / "key").public_key() in bundles.load_trusted(trusted)
    (tmp_path / "key").chmod(0o644)
    with pytest.raises(IdentityError, match="may be read by others"):
        bundles.load_key(tmp_path / "key")


@pytest.mark.parametrize(
    "text", [None, b"", b"nothing", b"-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n"]
)
def test_without_trusted_keys_nothing_is_installed(tmp_path: Path, text: bytes | None) -> None:
    """No file, an empty one, and one that holds no key are errors that say where the key belongs."""
    path = tmp_path / "release.pub"
    if text is not None:
        path.write_bytes(text)
    with pytest.raises(IdentityError) as caught:
        bundles.load_trusted(path)
    assert str(path) in caught.value.remedy


@pytest.mark.parametrize("content", [b"", b"x" * 3000, b"PK\x03\x04" + bytes(2000)])
def test_what_is_no_bundle(tmp_path: Path, key: Ed25519PrivateKey, content: bytes) -> None:
    """Empty and other files are refused as such."""
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(SwiftbotError, match=r"no bundle|cut off"), bundles.opened(path, (key.public_key(),)):
        pass
