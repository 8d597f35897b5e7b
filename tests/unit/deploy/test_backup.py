"""Backups: a gateway comes back on another box as it was; what cannot be read changes nothing there."""

import asyncio
import io
import json
import os
import shutil
import sqlite3
import tarfile
import time
from pathlib import Path
from typing import IO, cast

import pytest

from appliance import durable
from appliance.deploy import backup
from appliance.deploy.sealed import Sealer
from appliance.errors import ConfigError, ConflictError, IdentityError, PayloadError, RefusedError, SwiftbotError
from appliance.plane.leases import FENCE
from appliance.plane.store import Store

pytestmark = pytest.mark.anyio
WORDS = "a long enough passphrase"
SECRET = b"-----BEGIN PRIVATE KEY-----\nverysecret\n"


class Box:
    """A gateway's files."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = folder / "etc/gateway.toml"
        self.data = folder / "data"
        self.model = folder / "models/mine"
        self.file = folder.parent / f"{folder.name}.backup"
        for each in (self.config.parent / "keys", self.data / "artifacts", self.data / "cache", self.model):
            each.mkdir(parents=True)
        self.config.write_text(
            f'id = "gw-1"\nfleet = "yard"\ndata_dir = "{self.data}"\n[llm]\nlocal_model = "{self.model}"\n'
        )
        key = self.config.parent / "keys/gateway-gw-1.pem"
        key.write_bytes(SECRET)
        key.chmod(0o600)
        (self.model / "model.onnx").write_bytes(os.urandom(3_000_000))
        (self.data / "artifacts/a").write_text("kept")
        (self.data / "cache/c").write_text("made again")
        (self.data / "link").symlink_to("artifacts/a")
        with sqlite3.connect(self.data / "gateway.sqlite") as db:
            db.execute("PRAGMA journal_mode = WAL")
        db.close()

    async def fill(self) -> None:
        """Open its store as a gateway does, and write to it."""
        store = await Store.open(self.data / "gateway.sqlite")
        await store.put("robot/ledger", b"done")
        await store.put(FENCE, b"41")
        await store.close()

    async def back_up(self) -> backup.Contents:
        """Write a backup."""
        return await backup.back_up(
            self.file, self.config, WORDS, version="1.0", volumes=False, say=lambda _: None, cost_log2=2
        )

    async def restore(self, root: Path, *, replace: bool = False) -> backup.Contents:
        """Restore it into a folder."""
        return await backup.restore(self.file, WORDS, root=root, replace=replace, volumes=False, say=lambda _: None)

    def at(self, root: Path, path: Path) -> Path:
        """Where something is after a restore."""
        return root / str(path).lstrip("/")


@pytest.fixture
async def box(tmp_path: Path) -> Box:
    """A gateway that has worked."""
    made = Box(tmp_path / "box")
    await made.fill()
    return made


async def test_a_gateway_comes_back_on_another_box(box: Box, tmp_path: Path) -> None:
    """Configuration, keys with their modes, records, artifacts, links and models; not what is made again."""
    written = await box.back_up()
    root = tmp_path / "new"
    root.mkdir()
    found = await box.restore(root)
    assert (found.gateway, found.fleet, found.files, found.aside) == ("gw-1", "yard", written.files, ())
    for path in (box.config, box.config.parent / "keys/gateway-gw-1.pem", box.model / "model.onnx", box.data / "link"):
        assert box.at(root, path).read_bytes() == path.read_bytes()
    assert box.at(root, box.config.parent / "keys/gateway-gw-1.pem").stat().st_mode & 0o777 == 0o600
    assert box.at(root, box.data / "link").is_symlink()
    assert not box.at(root, box.data / "cache/c").exists()
    store = await Store.open(box.at(root, box.data / "gateway.sqlite"))
    assert await store.get("robot/ledger") == b"done"
    await store.close()
    assert box.file.stat().st_mode & 0o777 == 0o600
    assert b"verysecret" not in box.file.read_bytes()


async def test_a_restored_gateway_grants_nothing_twice(box: Box, tmp_path: Path) -> None:
    """Its fence is far above what it had granted at the backup, and its file is as old as that."""
    made = (await box.back_up()).made
    (tmp_path / "new").mkdir()
    await box.restore(tmp_path / "new")
    path = box.at(tmp_path / "new", box.data / "gateway.sqlite")
    assert abs(path.stat().st_mtime - made) < 1
    store = await Store.open(path)
    assert int(await store.get(FENCE) or 0) == 41 + backup.FENCE_JUMP
    await store.close()


async def test_records_are_copied_while_the_gateway_writes(box: Box, tmp_path: Path) -> None:
    """What was written before is in the copy, whole, though the store is open and its log is not merged."""
    store = await Store.open(box.data / "gateway.sqlite")
    for number in range(50):
        await store.put(f"key/{number}", b"x" * 1000)
    writing = asyncio.create_task(_write_on(store))
    await box.back_up()
    writing.cancel()
    await asyncio.gather(writing, return_exceptions=True)
    await store.close()
    (tmp_path / "new").mkdir()
    await box.restore(tmp_path / "new")
    again = await Store.open(box.at(tmp_path / "new", box.data / "gateway.sqlite"))
    assert len(await again.scan("key/")) == 50
    await again.close()


async def _write_on(store: Store) -> None:
    number = 0
    while True:
        number += 1
        await store.put(f"more/{number}", b"y")


async def test_what_cannot_be_read_changes_nothing(box: Box, tmp_path: Path) -> None:
    """A wrong passphrase, files cut off at many places, one changed byte, another file: refused, nothing written."""
    await box.back_up()
    root = tmp_path / "new"
    root.mkdir()
    whole = box.file.read_bytes()
    with pytest.raises(IdentityError, match="wrong passphrase"):
        await backup.restore(box.file, "another passphrase", root=root, say=lambda _: None)
    for cut in (0, 10, 100, 5000, len(whole) // 2, len(whole) - 20, len(whole) - 1):
        box.file.write_bytes(whole[:cut])
        with pytest.raises(PayloadError):
            await box.restore(root)
    box.file.write_bytes(whole[:-100] + bytes([whole[-100] ^ 1]) + whole[-99:])
    with pytest.raises(PayloadError):
        await box.restore(root)
    box.file.write_bytes(b"something else" * 1000)
    with pytest.raises(PayloadError, match="no backup"):
        await box.restore(root)
    assert list(root.iterdir()) == []


async def test_a_gateway_that_is_here_is_not_overwritten(box: Box) -> None:
    """A running one, and records that are here, are refused; with `replace` they are moved aside, not removed."""
    await box.back_up()
    store = await Store.open(box.data / "gateway.sqlite")
    with pytest.raises(ConflictError, match="a gateway runs"):
        await box.restore(Path("/"), replace=True)
    await store.put("newer", b"1")
    await store.close()
    with pytest.raises(ConflictError, match="has the records of a gateway"):
        await box.restore(Path("/"))
    found = await box.restore(Path("/"), replace=True)
    assert len(found.aside) == 2
    old = await Store.open(Path(next(each for each in found.aside if "data" in each)) / "gateway.sqlite")
    assert await old.get("newer") == b"1"
    await old.close()
    now = await Store.open(box.data / "gateway.sqlite")
    assert await now.get("newer") is None
    await now.close()


async def test_data_below_the_folder_of_the_configuration(tmp_path: Path) -> None:
    """Its fence is raised there too, and what was there is moved aside with that folder."""
    box = Box(tmp_path / "box")
    moved = box.config.parent / "data"
    box.data.rename(moved)
    box.config.write_text(box.config.read_text().replace(str(box.data), str(moved)))
    box.data = moved
    await box.fill()
    await box.back_up()
    found = await box.restore(Path("/"), replace=True)
    assert len(found.aside) == 1
    store = await Store.open(box.data / "gateway.sqlite")
    assert int(await store.get(FENCE) or 0) == 41 + backup.FENCE_JUMP
    await store.close()
    assert not list(box.folder.glob(".*"))


async def test_links_and_second_names_come_back(box: Box, tmp_path: Path) -> None:
    """A link to what is written after it, one to what is not there, and a file that has two names."""
    outside = tmp_path / "outside"
    outside.write_text("another's")
    touched = outside.stat().st_ctime_ns
    for folder in (box.data, box.model):
        (folder / "a-later").symlink_to("z")
        (folder / "nowhere").symlink_to("gone")
        (folder / "outside").symlink_to(outside)
        (folder / "z").write_text("content")
        (folder / "z2").hardlink_to(folder / "z")
    await box.back_up()
    root = tmp_path / "new"
    root.mkdir()
    await box.restore(root)
    for folder in (box.data, box.model):
        at = box.at(root, folder)
        assert [(at / name).read_text() for name in ("a-later", "z", "z2")] == ["content"] * 3
        assert str((at / "nowhere").readlink()) == "gone"
    assert outside.stat().st_ctime_ns == touched, "owner or mode of a file outside was set through a link"


async def test_single_files_are_moved_aside_where_they_differ(box: Box) -> None:
    """A model outside of the gateway's folders that was changed since the backup is kept."""
    await box.back_up()
    (box.model / "model.onnx").write_text("newer")
    found = await box.restore(Path("/"), replace=True)
    old = [Path(each) for each in found.aside if "model.onnx" in each]
    assert [each.read_text() for each in old] == ["newer"]
    assert (box.model / "model.onnx").stat().st_size == 3_000_000


async def test_files_are_closed_to_others_while_they_are_written(
    box: Box, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A private key has mode 0600 from its first byte on."""
    await box.back_up()
    modes: set[int] = set()
    real = shutil.copyfileobj

    def copy(source: IO[bytes], target: IO[bytes], size: int) -> None:
        modes.add(os.fstat(target.fileno()).st_mode & 0o777)
        real(source, target, size)

    monkeypatch.setattr(shutil, "copyfileobj", copy)
    (tmp_path / "new").mkdir()
    await box.restore(tmp_path / "new")
    assert modes == {0o600}


async def test_volumes_stay_where_a_restore_is_refused(box: Box, monkeypatch: pytest.MonkeyPatch) -> None:
    """State volumes that are here are removed only when all of the backup is taken out beside its place."""
    done: list[tuple[str, ...]] = []

    async def podman(*words: str, **options: object) -> str:
        done.append(words)
        if words[2] == "export":
            cast("Path", options["out"]).write_bytes(b"state")
        labels = {backup.LABEL_FLEET: "yard", backup.LABEL_GATEWAY: "gw-1"}
        found = json.dumps([{"Name": "state-a", "Labels": labels}])
        return found if "json" in words else "state-a\n" if words[2] == "ls" else ""

    monkeypatch.setattr(backup, "command", podman)
    await backup.back_up(box.file, box.config, WORDS, version="1.0", say=lambda _: None, cost_log2=2)
    full = shutil.disk_usage("/")._replace(free=0)

    def disk_usage(_: Path) -> object:
        return full

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", disk_usage)
        with pytest.raises(RefusedError, match="MiB free"):
            await backup.restore(box.file, WORDS, replace=True, say=lambda _: None)
    assert not [words for words in done if words[2] == "rm"]
    await backup.restore(box.file, WORDS, replace=True, say=lambda _: None)
    assert [words[2] for words in done[-3:]] == ["rm", "create", "import"]


async def test_a_restore_that_was_cut_is_done_again(box: Box, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut before any rename: the next restore finishes; nothing of the first is left over."""
    await box.back_up()
    real = durable.rename

    class CutError(BaseException):
        """The power goes."""

    number = 0
    while True:
        number += 1
        root = tmp_path / f"new-{number}"
        root.mkdir()
        left = number

        def rename(source: Path, target: Path) -> None:
            nonlocal left
            left -= 1
            if left == 0:
                raise CutError
            real(source, target)

        monkeypatch.setattr(durable, "rename", rename)
        try:
            await box.restore(root)
        except CutError:
            monkeypatch.setattr(durable, "rename", real)
            await box.restore(root, replace=True)
        else:
            break
        assert box.at(root, box.config).read_text() == box.config.read_text()
        assert (box.at(root, box.data) / "artifacts/a").read_text() == "kept"
        assert [each for each in root.rglob("*") if each.name.endswith(".restoring")] == []
    assert number > 2


@pytest.mark.parametrize("name", ["files/../../etc/cron.d/x", "elsewhere/x", "/etc/passwd"])
async def test_names_that_lead_elsewhere(tmp_path: Path, name: str) -> None:
    """A file with the right passphrase too may name only what a backup has."""
    file = tmp_path / "file"
    with file.open("wb") as out:
        sealer = Sealer(out, WORDS, cost_log2=2)
        with tarfile.open(fileobj=cast("io.BytesIO", sealer), mode="w|") as tar:
            manifest = backup.Manifest(
                gateway="g", fleet="f", version="1", made=time.time(), config="/c/x", data_dir="/d", volumes={}
            )
            for entry, content in ((backup.MANIFEST, backup.msgspec.json.encode(manifest)), (name, b"")):
                info = tarfile.TarInfo(entry)
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
        sealer.close()
    (tmp_path / "new").mkdir()
    with pytest.raises(PayloadError, match="names"):
        await backup.restore(file, WORDS, root=tmp_path / "new", say=lambda _: None)


@pytest.mark.parametrize("folder", ["/", "/etc", "/root", "/home/operator", "/var/lib"])
async def test_folders_of_the_system_are_never_replaced(box: Box, tmp_path: Path, folder: str) -> None:
    """A gateway whose files lie among others' is not backed up, and a backup that names such a folder not restored."""
    with pytest.raises(RefusedError, match="not the gateway's alone") as caught:
        backup.check_folders(box.data, Path(folder))
    assert "folders of their own" in caught.value.remedy
    box.config.write_text(box.config.read_text().replace(str(box.data), folder))
    with pytest.raises(RefusedError, match="not the gateway's alone"):
        await box.back_up()
    file = tmp_path / "file"
    with file.open("wb") as out:
        sealer = Sealer(out, WORDS, cost_log2=2)
        with tarfile.open(fileobj=cast("io.BytesIO", sealer), mode="w|") as tar:
            manifest = backup.Manifest(
                gateway="g", fleet="f", version="1", made=0.0, config="/c/x", data_dir=folder, volumes={}
            )
            content = backup.msgspec.json.encode(manifest)
            info = tarfile.TarInfo(backup.MANIFEST)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
        sealer.close()
    (tmp_path / "new").mkdir()
    with pytest.raises(RefusedError, match="not the gateway's alone"):
        await backup.restore(file, WORDS, root=tmp_path / "new", say=lambda _: None)
    assert not list((tmp_path / "new").iterdir())


async def test_a_backup_that_another_one_wrote_meanwhile_stays(box: Box, monkeypatch: pytest.MonkeyPatch) -> None:
    """The name is free at the start and taken at the end: what is there then is kept."""
    real = durable.sync_file

    def sync(path: Path) -> None:
        real(path)
        box.file.write_text("the other's")

    monkeypatch.setattr(durable, "sync_file", sync)
    with pytest.raises(ConfigError, match="exists"):
        await box.back_up()
    assert box.file.read_text() == "the other's"


async def test_mistakes_name_the_remedy(box: Box) -> None:
    """A short passphrase, a file that is there, no configuration."""
    with pytest.raises(ConfigError, match="has 5 characters"):
        await backup.back_up(box.file, box.config, "short", version="1", say=lambda _: None)
    box.file.write_text("")
    with pytest.raises(ConfigError, match="exists"):
        await box.back_up()
    with pytest.raises(SwiftbotError, match="cannot be read"):
        await backup.back_up(box.folder / "x", box.folder / "none", WORDS, version="1", say=lambda _: None)
