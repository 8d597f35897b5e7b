"""Fetching from peers that drop, lie, repeat, cut off, stall and die: the result is whole, or there is none."""

import asyncio
import contextlib
import hashlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.errors import DeadlineError, NotFoundError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.model.keys import Keys
from appliance.model.transfer_api import Manifest, ManifestOffer
from appliance.plane.node import Plane
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes import target as spool_module
from appliance.pool.volumes.archive import Digests
from appliance.pool.volumes.source import Offer, Offers, opened
from appliance.pool.volumes.target import Arrival, Fetcher, Job, Spool

pytestmark = pytest.mark.anyio

CHUNK = 16 * 1024
CONTENT = b"".join(hashlib.sha256(b"%d" % number).digest() * 16 for number in range(150)) + b"the end"
"""Some 75 kB: five chunks, of which the last is short."""
FATES = ["ok", "drop", "slow", "busy", "forgot", "lie", "short", "other", "bomb", "noise", "dies"]


def described(content: bytes, name: str = "v") -> Manifest:
    """Return the manifest of a content."""
    digests = Digests(CHUNK)
    digests.update(content)
    return digests.manifest("volume", name)


class Peer:
    """A gateway that gives one thing; each question for a chunk meets the next fate, then all is well."""

    def __init__(self, content: bytes, fates: list[str] | None = None, *, folder: Path) -> None:
        self.manifest, self.fates = described(content), list(fates or [])
        path = folder / f"content-{hashlib.sha256(content).hexdigest()}"
        path.write_bytes(content)
        self.offer = Offer(path, self.manifest, checked=False)
        self.dead = False
        self.asked = 0

    def answer(self, digest: str, index: int, *, zstd: bool) -> bytes:
        """Answer a question for a chunk, or not."""
        self.asked += 1
        fate = self.fates.pop(0) if self.fates else "ok"
        self.dead = self.dead or fate == "dies"
        errors: dict[str, SwiftbotError] = {
            "drop": UnreachableError("dropped"),
            "slow": DeadlineError("slow"),
            "busy": RefusedError("busy"),
            "forgot": NotFoundError("forgot"),
        }
        if self.dead:
            raise UnreachableError("dead")
        if fate in errors:
            raise errors[fate]
        if digest != self.manifest.digest:
            raise NotFoundError("that is not what I have")
        good = self.offer.chunk(index, zstd=zstd)
        changed = bytearray(good)
        changed[len(good) // 2] ^= 1
        return {
            "lie": bytes(changed),
            "short": good[:-1],
            "other": self.offer.chunk((index + 1) % self.manifest.count, zstd=zstd),
            "bomb": b"\x01" + bytes.fromhex("28b52ffde0ffffffffffffff7f"),
            "noise": b"",
        }.get(fate, good)


class FakePlane:
    """As much of a plane as fetching uses."""

    gateway = "here"

    def __init__(self, peers: dict[str, Peer]) -> None:
        self.peers, self.keys = peers, Keys("f")
        self.rpc = self.session = self

    async def call(self, gateway: str, *_: object, timeout_s: float) -> ManifestOffer:
        """Ask for a manifest."""
        assert timeout_s > 0
        peer = self.peers[gateway]
        if peer.dead:
            raise UnreachableError("dead")
        return ManifestOffer(manifest=peer.manifest)

    async def query(self, key: str, payload: bytes, *, timeout_s: float, bulk: bool) -> bytes:
        """Ask for a chunk."""
        assert bulk
        assert timeout_s > 0
        await asyncio.sleep(0)
        _, _, _, gateway, _, digest, index = key.split("/")
        return self.peers[gateway].answer(digest, int(index), zstd=payload == b"zstd")


class Receiver:
    """A gateway that fetches."""

    def __init__(self, folder: Path, **config: Any) -> None:
        self.config = TransferConfig(**{"reserve_mb": 0, "patience_s": 0.05, **config})
        self.folder, self.refused = folder, Counter[str]()
        self.spool, self.offers = Spool(folder / "spool", self.config), Offers(folder / "offers", self.config)
        self.spool.start()
        self.offers.start()

    async def fetch(self, peers: dict[str, Peer], **accept: Callable[[Manifest], str]) -> tuple[bytes, Job]:
        """Fetch from the peers in order, as a gateway that has just started; returns what came."""

        async def no_pause(_: float) -> None:
            await asyncio.sleep(0)

        fetcher = Fetcher(
            self.config,
            plane=cast("Plane", FakePlane(peers)),
            spool=self.spool,
            offers=self.offers,
            refused=self.refused,
            sleep=no_pause,
        )
        job = Job("j", "volume/v")
        try:
            arrival = await fetcher.fetch("volume", "v", list(peers), job, **accept)
            content = arrival.path.read_bytes()
            self.spool.close(arrival)
            return content, job
        finally:
            await fetcher.close()


@given(
    fates=st.lists(st.lists(st.sampled_from(FATES), max_size=25), min_size=1, max_size=3),
    tries=st.integers(1, 3),
)
@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
async def test_whole_or_not_at_all(
    fates: list[list[str]], tries: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whatever each question meets, a fetch ends with exactly the content or an error, and a later try goes on."""
    folder = tmp_path_factory.mktemp("fetch")
    peers = {f"g{number}": Peer(CONTENT, each, folder=folder) for number, each in enumerate(fates)}
    for _ in range(tries):
        receiver = Receiver(folder)  # each try as after a restart
        try:
            content, job = await receiver.fetch(peers)
        except SwiftbotError:
            continue
        assert content == CONTENT
        assert job.done_bytes == len(CONTENT)
    good = Peer(CONTENT, folder=folder)
    receiver = Receiver(folder)
    content, job = await receiver.fetch({"good": good})
    assert content == CONTENT
    assert good.asked == len(list(range(good.manifest.count))) - _chunks(job.resumed_bytes)


def _chunks(resumed_bytes: int) -> int:
    return -(-resumed_bytes // CHUNK)


@pytest.mark.parametrize("after", range(6))
async def test_goes_on_where_it_was(after: int, tmp_path: Path) -> None:
    """A source dies after any number of chunks; after a restart here another source gives only what is missing."""
    count = described(CONTENT).count
    receiver = Receiver(tmp_path, window=1)
    first = Peer(CONTENT, ["ok"] * after + ["dies"], folder=tmp_path)
    if after < count:
        with pytest.raises(UnreachableError):
            await receiver.fetch({"g1": first})
    else:
        await receiver.fetch({"g1": first})
    second = Peer(CONTENT, folder=tmp_path)
    content, job = await Receiver(tmp_path, window=1).fetch({"g2": second})
    assert content == CONTENT
    assert second.asked == max(0, count - after)
    assert _chunks(job.resumed_bytes) == min(after, count)


async def test_what_rotted_in_the_spool_comes_again(tmp_path: Path) -> None:
    """A chunk that changed on the disk while nobody looked is not believed, and fetched again."""
    receiver = Receiver(tmp_path, window=1)
    with pytest.raises(UnreachableError):
        await receiver.fetch({"g1": Peer(CONTENT, ["ok", "ok", "dies"], folder=tmp_path)})
    [data] = (tmp_path / "spool").glob("*/data")
    with data.open("r+b") as file:
        file.write(b"rot")
    second = Peer(CONTENT, folder=tmp_path)
    content, _ = await Receiver(tmp_path).fetch({"g1": second})
    assert content == CONTENT
    assert second.asked == second.manifest.count - 1


async def test_a_liar_is_left_for_another(tmp_path: Path) -> None:
    """Three bad chunks are counted, then the next source is asked; with none left the error says so."""
    receiver = Receiver(tmp_path, window=1)
    liar = Peer(CONTENT, ["lie"] * 100, folder=tmp_path)
    content, job = await receiver.fetch({"g1": liar, "g2": Peer(CONTENT, folder=tmp_path)})
    assert content == CONTENT
    assert job.source == "g2"
    assert receiver.refused["transfer bad chunk"] == 3
    with pytest.raises(PayloadError):
        await Receiver(tmp_path / "new", window=1).fetch({"g1": Peer(CONTENT, ["lie"] * 100, folder=tmp_path)})


async def test_a_state_that_changed_meanwhile(tmp_path: Path) -> None:
    """The source has moved on to a newer state: what both have in common is not fetched again."""
    receiver = Receiver(tmp_path, window=1)
    with pytest.raises(UnreachableError):
        await receiver.fetch({"g1": Peer(CONTENT, ["ok", "ok", "ok", "dies"], folder=tmp_path)})
    newer = CONTENT[:-7] + b"another end"
    peer = Peer(newer, folder=tmp_path)
    content, job = await Receiver(tmp_path).fetch({"g1": peer})
    assert content == newer
    assert peer.asked == peer.manifest.count - 3
    assert job.resumed_bytes == 3 * CHUNK
    assert len(list((tmp_path / "spool").iterdir())) == 1


async def test_a_source_that_has_something_else_is_left(tmp_path: Path) -> None:
    """A manifest that will not do, or that contradicts itself, sends us to the next source."""
    receiver = Receiver(tmp_path)
    wrong = Peer(b"something else", folder=tmp_path)
    content, _ = await receiver.fetch(
        {"g1": wrong, "g2": Peer(CONTENT, folder=tmp_path)},
        accept=lambda manifest: "" if manifest.size_bytes == len(CONTENT) else "older",
    )
    assert content == CONTENT
    with pytest.raises(NotFoundError, match="older"):
        await receiver.fetch({"g1": wrong}, accept=lambda _: "older")
    mad = Peer(CONTENT, folder=tmp_path)
    mad.manifest = Manifest(
        kind="volume", name="v", digest="0" * 64, size_bytes=2**50, chunk_bytes=CHUNK, chunks=b"x" * 32
    )
    with pytest.raises(RefusedError):
        await Receiver(tmp_path / "new").fetch({"g1": mad})


async def test_full_disk_at_any_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No room for the fourth chunk: the error says what to do, all of the arrival is removed, a later try is whole."""
    receiver, written, real = Receiver(tmp_path, window=1), 0, Arrival._write

    def write(self: Arrival, data: bytes, offset: int) -> None:
        nonlocal written
        written += 1
        if written == 4:
            raise OSError(28, "No space left on device")
        real(self, data, offset)

    monkeypatch.setattr(spool_module.Arrival, "_write", write)
    with pytest.raises(RefusedError, match="no more room") as caught:
        await receiver.fetch({"g1": Peer(CONTENT, folder=tmp_path)})
    assert caught.value.remedy
    assert list((tmp_path / "spool").iterdir()) == []
    content, _ = await receiver.fetch({"g1": Peer(CONTENT, folder=tmp_path)})
    assert content == CONTENT


def test_spool_is_bounded(tmp_path: Path) -> None:
    """What was left longest ago goes when room is needed; what does not fit at all is refused."""
    config = TransferConfig(reserve_mb=0, spool_mb=1)
    spool = Spool(tmp_path / "spool", config)
    spool.start()
    for number in range(12):
        content = bytes([number]) * 200_000
        arrival = spool.open(described(content, f"v{number}"))
        arrival.put(0, content[:CHUNK])
        spool.close(arrival)
        assert sum(each.stat().st_blocks * 512 for each in (tmp_path / "spool").glob("*/*")) <= 2**20 + 2 * CHUNK
    assert 3 <= len(list((tmp_path / "spool").iterdir())) < 12
    with pytest.raises(RefusedError, match="do not fit"):
        spool.open(described(bytes(2 * 2**20)))
    (tmp_path / "spool" / "stranger").mkdir()
    Spool(tmp_path / "spool", config).start()
    assert not (tmp_path / "spool" / "stranger").exists()


def test_a_disk_without_reserve_refuses(tmp_path: Path) -> None:
    """A transfer that would take the disk's last megabytes is refused before it begins."""
    spool = Spool(tmp_path / "spool", TransferConfig(reserve_mb=2**40))
    spool.start()
    with pytest.raises(RefusedError, match="stay so"):
        spool.open(described(CONTENT))


@given(answer=st.binary(max_size=200), length=st.integers(1, 100))
def test_answers_are_chunks_or_refused(answer: bytes, length: int) -> None:
    """Any bytes for an answer are a chunk of exactly the length announced, or refused."""
    with contextlib.suppress(PayloadError):
        assert len(opened(answer, length)) == length


def test_offers_outlive_restarts_and_are_bounded(tmp_path: Path) -> None:
    """What was kept is given again after a restart, unless it changed on the disk; beyond the bound the oldest goes."""
    config = TransferConfig(reserve_mb=0, cache_mb=1)
    offers = Offers(tmp_path / "offers", config)
    offers.start()
    for number in range(8):
        content = bytes([number]) * 200_000
        draft = offers.draft()
        draft.write_bytes(content)
        offers.add(described(content, f"v{number}"), draft)
    kept = [each.manifest.name for each in offers]
    assert kept == ["v3", "v4", "v5", "v6", "v7"]
    again = Offers(tmp_path / "offers", config)
    again.start()
    assert sorted(each.manifest.name for each in again) == kept
    offer = again.find("volume", "v7")
    assert offer is not None
    assert opened(offer.chunk(0, zstd=True), CHUNK) == bytes([7]) * CHUNK
    offer.path.write_bytes(bytes(200_000))
    with pytest.raises(NotFoundError, match="damaged"):
        offer.chunk(0, zstd=False)
    with pytest.raises(PayloadError):
        offer.chunk(99, zstd=False)
