"""The ledger of state volumes: versions grow with changes, the newest is known, and no state is lost."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any, cast

import pytest

from appliance.errors import ConflictError, NotFoundError, RefusedError, UnreachableError
from appliance.model import VersionVector, VolumeInfo
from appliance.model.plane_api import Record
from appliance.model.transfer_api import Manifest
from appliance.plane.records import increment
from appliance.plane.store import Store
from appliance.pool.engine import FoundVolume, PodmanEngine
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes.archive import pack
from appliance.pool.volumes.registry import Volumes
from appliance.pool.volumes.store import LABEL_KEPT, Place

pytestmark = pytest.mark.anyio

CHUNK = 16 * 1024


class FakeStorage:
    """Volumes as Podman has them, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.labels = folder, dict[str, dict[str, str]]()
        self.away = False
        self.used: set[str] = set()

    async def volume(self, name: str) -> FoundVolume:
        """Return a volume."""
        if name not in self.labels:
            raise NotFoundError(name)
        return FoundVolume(name=name, folder=self.folder / name / "_data", labels=self.labels[name])

    async def volumes(self, labels: Mapping[str, str]) -> list[FoundVolume]:
        """Return the volumes with these labels."""
        if self.away:
            raise UnreachableError("away")
        return [await self.volume(name) for name in sorted(self.labels) if labels.items() <= self.labels[name].items()]

    async def ensure_volume(self, name: str, labels: Mapping[str, str]) -> None:
        """Make a volume."""
        self.labels.setdefault(name, dict(labels))
        (self.folder / name / "_data").mkdir(parents=True, exist_ok=True)

    async def remove_volume(self, name: str) -> bool:
        """Remove a volume unless a container uses it."""
        if name in self.used:
            return False
        del self.labels[name]
        return True


class FakeRecords:
    """The fleet's records in one place."""

    def __init__(self) -> None:
        self.records: dict[str, Record] = {}
        self.away = False

    async def read(self, key: str) -> Record | None:
        """Return a record."""
        if self.away:
            raise UnreachableError("away")
        return self.records.get(key)

    async def write(
        self, key: str, value: bytes, *, expected: VersionVector | None, durable: bool = True
    ) -> VersionVector:
        """Compare and set."""
        assert durable
        before = self.records.get(key)
        if self.away:
            raise UnreachableError("away")
        if (before.version if before else None) != expected:
            raise ConflictError("moved on")
        version = increment(expected or {}, "owner")
        self.records[key] = Record(key=key, value=value, version=version)
        return version


class Fleet:
    """Gateways' ledgers over one record store."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.records = folder, FakeRecords()
        self.storages: dict[str, FakeStorage] = {}
        self.stores: list[Store] = []
        self.config = TransferConfig(reserve_mb=0, use_wait_s=0.05, backups=2)

    async def start(self, gateway: str) -> Volumes:
        """Start a gateway's ledger, again if it ran before."""
        (self.folder / gateway).mkdir(exist_ok=True)
        store = await Store.open(self.folder / gateway / f"{len(self.stores)}.sqlite")
        for before in self.stores:
            for key, value in await before.scan("volume/") if before.path.parent.name == gateway else ():
                await store.put(key, value)
        self.stores.append(store)
        storage = self.storages.setdefault(gateway, FakeStorage(self.folder / gateway))
        volumes = Volumes(
            self.config,
            fleet="f",
            gateway=gateway,
            store=store,
            records=self.records,
            storage=cast("PodmanEngine", storage),
        )
        await volumes.start()
        return volumes

    async def data(self, gateway: str, name: str = "v") -> Path:
        """Where a volume's files lie."""
        await self.storages[gateway].ensure_volume(
            f"swiftbot-f-{gateway}-{name}", {"swiftbot.fleet": "f", "swiftbot.gateway": gateway}
        )
        return self.folder / gateway / f"swiftbot-f-{gateway}-{name}" / "_data"

    async def change(self, volumes: Volumes, gateway: str, text: str) -> None:
        """Change a volume as a run does."""
        folder = await self.data(gateway)
        async with volumes.use(["v"]):
            (folder / "state").write_text(text)

    async def pack(self, volumes: Volumes, target: Path) -> Manifest:
        """Pack a state."""

        def work(folder: Path) -> Manifest:
            return pack(folder, target, name="v", chunk_bytes=CHUNK, most_files=100, most_bytes=2**20)

        return await volumes.packed("v", None, work)


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[Fleet]:
    """A fleet without gateways yet."""
    made = Fleet(tmp_path)
    yield made
    for store in made.stores:
        await store.close()


async def test_versions_grow_with_changes_only(fleet: Fleet) -> None:
    """A run that changed the volume makes a new generation that the fleet's record has; one that did not makes none."""
    a = await fleet.start("a")
    folder = await fleet.data("a")
    async with a.use(["v"]):
        pass
    assert a.infos() == ()
    assert await a.newest("v") is None
    await fleet.change(a, "a", "one")
    await fleet.change(a, "a", "two!")
    async with a.use(["v"]):
        (folder / "state").read_text()
    assert a.infos() == (VolumeInfo(name="v", gateway="a", generation=2, size_bytes=4),)
    newest = await a.newest("v")
    assert newest is not None
    assert (newest.version, newest.gateway, newest.size_bytes) == ({"a": 2}, "a", 4)
    await a.close()


async def test_a_failed_run_counts_too(fleet: Fleet) -> None:
    """A run that raises or is cancelled has changed what it changed."""
    a = await fleet.start("a")
    folder = await fleet.data("a")

    async def crash() -> None:
        async with a.use(["v"]):
            (folder / "state").write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await crash()

    async def run() -> None:
        async with a.use(["v"]):
            (folder / "more").write_text("half")
            await asyncio.sleep(60)

    task = asyncio.create_task(run())
    while not (folder / "more").exists():
        await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert a.state("v").version == {"a": 2}
    await a.close()


async def test_a_state_moves_on_and_back(fleet: Fleet, tmp_path: Path) -> None:
    """The newest state replaces an older one, grows there, and comes back; each side knows whose is newer."""
    a, b = await fleet.start("a"), await fleet.start("b")
    await fleet.change(a, "a", "one")
    manifest = await fleet.pack(a, tmp_path / "one")
    b.hear("a", a.infos())
    assert not b.newest_here("v")
    assert b.where("v") == ("a",)
    assert b.size_bytes(["v", "other"]) == 3
    assert await b.replace("v", manifest, tmp_path / "one")
    assert ((await fleet.data("b")) / "state").read_text() == "one"
    assert b.newest_here("v")
    assert b.where("v") == ("a", "b")
    await fleet.change(b, "b", "two")
    a.hear("b", b.infos())
    assert not a.newest_here("v")
    assert a.infos() == ()
    assert await a.replace("v", await fleet.pack(b, tmp_path / "two"), tmp_path / "two")
    assert ((await fleet.data("a")) / "state").read_text() == "two"
    assert not await a.replace("v", manifest, tmp_path / "one"), "an older state never replaces a newer"
    assert not [each for each in fleet.storages["a"].labels.values() if LABEL_KEPT in each]
    for each in (a, b):
        assert not each.refused
        await each.close()


async def test_the_losing_state_is_kept_aside(fleet: Fleet, tmp_path: Path) -> None:
    """Two gateways changed a state without knowing of each other: one stands, the other is kept, counted and found."""
    a, b = await fleet.start("a"), await fleet.start("b")
    await fleet.change(a, "a", "common")
    await b.replace("v", await fleet.pack(a, tmp_path / "common"), tmp_path / "common")
    await fleet.change(a, "a", "mine")
    await fleet.change(b, "b", "theirs")
    assert b.refused["volume changed on two gateways"] == 1
    newest = await b.newest("v")
    assert newest is not None
    assert newest.gateway == "a"
    assert not b.has("v", newest)
    assert await b.replace("v", await fleet.pack(a, tmp_path / "mine"), tmp_path / "mine")
    assert ((await fleet.data("b")) / "state").read_text() == "mine"
    [kept] = await fleet.storages["b"].volumes({LABEL_KEPT: "v"})
    assert (kept.folder / "state").read_text() == "theirs"
    assert b.refused["volume state kept aside"] == 1
    assert b.newest_here("v")
    for each in (a, b):
        await each.close()


async def test_kept_states_are_bounded(fleet: Fleet, tmp_path: Path) -> None:
    """Beyond the bound the oldest kept state goes, which is counted."""
    a, b = await fleet.start("a"), await fleet.start("b")
    for number in range(4):
        await fleet.change(b, "b", f"b{number}")
        for again in range(2):
            await fleet.change(a, "a", f"a{number}{again}")
        await b.replace("v", await fleet.pack(a, tmp_path / "state"), tmp_path / "state")
    kept = await fleet.storages["b"].volumes({LABEL_KEPT: "v"})
    assert [(each.folder / "state").read_text() for each in kept] == ["b2", "b3"]
    assert b.refused["kept volume removed"] == 2
    # One that a container uses stays, the state that lost now is kept all the same, and nothing is called removed.
    fleet.storages["b"].used.update(each.name for each in kept)
    await fleet.change(b, "b", "b4")
    for again in range(2):
        await fleet.change(a, "a", f"a4{again}")
    await b.replace("v", await fleet.pack(a, tmp_path / "state"), tmp_path / "state")
    kept = await fleet.storages["b"].volumes({LABEL_KEPT: "v"})
    assert [(each.folder / "state").read_text() for each in kept] == ["b2", "b3", "b4"]
    assert b.refused["kept volume removed"] == 2
    for each in (a, b):
        await each.close()


async def test_a_volume_in_use_is_neither_replaced_nor_packed(fleet: Fleet, tmp_path: Path) -> None:
    """While a run uses it a volume is refused to both sides; the last packed state is given, if it is the newest."""
    a, b = await fleet.start("a"), await fleet.start("b")
    await fleet.change(a, "a", "one")
    manifest = await fleet.pack(a, tmp_path / "one")
    async with b.use(["v"]):
        with pytest.raises(RefusedError, match="used by a run"):
            await b.replace("v", manifest, tmp_path / "one")
    async with a.use(["v"]):
        with pytest.raises(RefusedError, match="uses volume"):
            await fleet.pack(a, tmp_path / "two")
        assert await a.packed("v", manifest, lambda _: pytest.fail("it was packed")) is manifest
    assert b.refused["volume busy"] == a.refused["volume busy"] == 1
    with pytest.raises(NotFoundError):
        await fleet.pack(b, tmp_path / "two")
    for each in (a, b):
        await each.close()


async def test_what_changed_unseen_is_noted_at_the_next_start(fleet: Fleet) -> None:
    """A gateway killed in mid-run notes the change when it starts again; one that told nobody tells then."""
    a = await fleet.start("a")
    await fleet.change(a, "a", "one")
    await a.close()
    ((await fleet.data("a")) / "state").write_text("changed by a run nobody saw end")
    fleet.records.away = True
    a = await fleet.start("a")
    assert a.state("v").version == {"a": 2}
    assert not a.state("v").told
    fleet.records.away = False
    async with asyncio.timeout(20):
        while not a.state("v").told:
            await asyncio.sleep(0.01)
    newest = await a.newest("v")
    assert newest is not None
    assert newest.version == {"a": 2}
    await a.close()


@pytest.mark.parametrize("renames", range(4))
async def test_a_swap_cut_off_is_ended_at_the_next_start(fleet: Fleet, tmp_path: Path, renames: int) -> None:
    """A gateway killed after any rename of a swap has the whole new state, and its version, when it starts again."""
    a, b = await fleet.start("a"), await fleet.start("b")
    folder = await fleet.data("a")
    async with a.use(["v"]):
        (folder / "x").write_text("new")
        (folder / "y").write_text("new")
    await fleet.pack(a, tmp_path / "new")
    await fleet.change(b, "b", "old")
    await b.close()
    place = Place(await fleet.data("b"))
    incoming = place.prepare()
    (incoming / "x").write_text("new")
    (incoming / "y").write_text("new")
    journal = place.begin({"a": 1}, "a", keep="swiftbot-f-b-v.kept-1")
    for _, (source, target) in zip(range(renames), place.steps(journal), strict=False):
        source.rename(target)
    b = await fleet.start("b")
    assert {each.name: each.read_text() for each in place.root.iterdir()} == {"x": "new", "y": "new"}
    assert b.state("v").version == {"a": 1}
    kept = await fleet.storages["b"].volume("swiftbot-f-b-v.kept-1")
    assert (kept.folder / "state").read_text() == "old"
    assert not place.work.exists()
    for each in (a, b):
        await each.close()


async def test_bad_names_and_damaged_records(fleet: Fleet) -> None:
    """A name that is no key is refused; a record or ledger entry that cannot be read is counted and written again."""
    a = await fleet.start("a")
    with pytest.raises(Exception, match="not a valid name"):
        async with a.use(["../etc"]):
            pass
    fleet.records.records["volume/v"] = Record(key="volume/v", value=b"noise", version={"z": 1})
    await fleet.change(a, "a", "one")
    assert a.refused["volume record damaged"] == 1
    newest = await a.newest("v")
    assert newest is not None
    assert newest.version == {"a": 1}
    await a.close()
    await fleet.stores[-1].put("volume/v", b"noise")
    again = await fleet.start("a")
    assert again.refused["volume ledger damaged"] == 1
    assert again.state("v").version == {"a": 1}
    await again.close()


async def test_podman_away_at_the_start(fleet: Fleet) -> None:
    """Without Podman the ledger is there all the same."""
    fleet.storages["a"] = FakeStorage(fleet.folder / "a")
    fleet.storages["a"].away = True
    a: Any = await fleet.start("a")
    assert a.infos() == ()
    await a.close()
