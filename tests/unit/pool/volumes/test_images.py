"""An image from gateways of which some are dead, lie or do not have it."""

import hashlib
import json
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.errors import IdentityError, NotFoundError, UnreachableError
from appliance.identity.parts import ALL, InForce, Parts, seal
from appliance.model.transfer_api import ImageLayout, Manifest, ManifestAsk, ManifestOffer
from appliance.plane.node import Plane
from appliance.pool.engine import FoundImage, ImageFacts, PodmanEngine
from appliance.pool.settings import TransferConfig
from appliance.pool.volumes.archive import Digests
from appliance.pool.volumes.registry import Volumes
from appliance.pool.volumes.transfers import Transfers

pytestmark = pytest.mark.anyio

REFERENCE = "localhost/fleet/image:1"
LAYER = b"a layer" * 100


def digest(content: bytes) -> str:
    """SHA-256, hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def config(layer: bytes) -> bytes:
    """Return the configuration of an image of one layer."""
    return json.dumps({"rootfs": {"type": "layers", "diff_ids": [f"sha256:{digest(layer)}"]}}).encode()


def layout(config: bytes, layer: bytes) -> bytes:
    """Return what an image is made of, as it is sent."""
    return msgspec.json.encode(ImageLayout(reference=REFERENCE, image_id=digest(config), layers=(digest(layer),)))


class Peer:
    """A gateway with these things: kind and name -> content."""

    def __init__(self, **has: bytes | list[bytes]) -> None:
        self.has: dict[tuple[str, str], bytes] = {}
        for blob in cast("list[bytes]", has.get("blobs", [])):
            self.has["blob", digest(blob)] = blob
        if "layout" in has:
            self.has["image", REFERENCE] = cast("bytes", has["layout"])

    def manifest(self, kind: str, name: str) -> Manifest:
        """Return the manifest of a thing."""
        if (kind, name) not in self.has:
            raise NotFoundError(f"no {kind} {name[:12]} here")
        digests = Digests(16 * 1024)
        digests.update(self.has[kind, name])
        return digests.manifest(kind, name)


class FakePlane:
    """As much of a plane as transfers of images use; a peer of None is dead."""

    gateway = "here"
    config = types.SimpleNamespace(max_payload_bytes=8 * 2**20)
    registry = types.SimpleNamespace(gateways={})

    def __init__(self, peers: dict[str, Peer | None]) -> None:
        self.peers = peers
        self.asked: list[str] = []
        self.rpc = self.session = self

    def keys(self, _: object, *names: str) -> str:
        """Return a key."""
        return "/".join(names)

    def members(self) -> frozenset[str]:
        """Return who is there."""
        return frozenset({"here", *self.peers})

    def put(self, *_: object) -> None:
        """Publish progress."""

    def _peer(self, gateway: str) -> Peer:
        peer = self.peers[gateway]
        if peer is None:
            raise UnreachableError(f"{gateway} does not answer")
        return peer

    async def call(self, gateway: str, _: object, ask: ManifestAsk, *, timeout_s: float) -> ManifestOffer:
        """Ask for a manifest."""
        assert timeout_s > 0
        self.asked.append(f"{gateway} {ask.kind}")
        return ManifestOffer(manifest=self._peer(gateway).manifest(ask.kind, ask.name))

    async def query(self, key: str, *_: object, timeout_s: float, bulk: bool) -> bytes:
        """Ask for a chunk."""
        assert bulk
        assert timeout_s > 0
        gateway, whole, index = key.split("/")
        peer = self._peer(gateway)
        for (kind, name), content in peer.has.items():
            manifest = peer.manifest(kind, name)
            if manifest.digest == whole:
                offset, length = manifest.span(int(index))
                return b"\x00" + content[offset : offset + length]
        raise NotFoundError("that is not what I have")


class FakeStorage:
    """Podman's images."""

    def __init__(self) -> None:
        self.loaded: ImageFacts | None = None

    async def has_image(self, _: str) -> bool:
        """Whether an image is there."""
        return self.loaded is not None

    async def layers(self) -> frozenset[str]:
        """Return the layers that are there."""
        return frozenset()

    async def load_image(self, archive: Callable[[], Iterator[bytes]]) -> None:
        """Load an image."""
        assert b"".join(archive())
        self.loaded = ImageFacts(id=digest(config(LAYER)), layers=(digest(LAYER),))

    async def image(self, _: str) -> ImageFacts:
        """Return what was loaded."""
        assert self.loaded is not None
        return self.loaded

    async def images(self) -> list[FoundImage]:
        """Return the images."""
        return [FoundImage(id="i", tags=(REFERENCE,), size_bytes=1, created="")] if self.loaded else []


def fetching(
    folder: Path, peers: dict[str, Peer | None], named: InForce = ALL
) -> tuple[Transfers, FakePlane, FakeStorage]:
    """Return the transfers of a gateway that sees these peers."""
    plane, storage = FakePlane(peers), FakeStorage()
    settings = TransferConfig(reserve_mb=0, patience_s=3600.0)
    parts: dict[str, Any] = {
        "parts": named,
        "plane": cast("Plane", plane),
        "volumes": cast("Volumes", None),
        "data_dir": folder,
    }
    for part in ("arriving", "offered"):
        (folder / "transfer" / part).mkdir(parents=True)
    return Transfers(settings, storage=cast("PodmanEngine", storage), **parts), plane, storage


async def test_a_start_does_not_wait_for_a_dead_gateway(tmp_path: Path) -> None:
    """A source that does not answer is asked once; the error names it, though another one has no such image."""
    transfers, plane, _ = fetching(tmp_path, {"g0": None, "g1": Peer()})
    with pytest.raises(UnreachableError, match="g0 does not answer"):
        await transfers.bring_image(REFERENCE)
    assert plane.asked == ["g0 image", "g1 image"]


async def test_another_gateway_has_it(tmp_path: Path) -> None:
    """The next source is asked at once."""
    good = Peer(layout=layout(config(LAYER), LAYER), blobs=[config(LAYER), LAYER])
    transfers, plane, storage = fetching(tmp_path, {"g0": None, "g1": good})
    brought = await transfers.bring_image(REFERENCE)
    assert brought.gateway == "g1"
    assert storage.loaded is not None
    assert plane.asked[:2] == ["g0 image", "g1 image"]


async def test_the_gateway_of_a_wrong_layout_is_left(tmp_path: Path) -> None:
    """A layout that contradicts its parts sends us to the next layout, whichever gateway gave the parts."""
    other = b"another layer"
    liar = Peer(layout=layout(config(other), LAYER))
    good = Peer(layout=layout(config(LAYER), LAYER), blobs=[config(LAYER), config(other), LAYER])
    transfers, plane, storage = fetching(tmp_path, {"g0": liar, "g1": good})
    await transfers.bring_image(REFERENCE)
    assert storage.loaded is not None
    assert [each for each in plane.asked if each.endswith("image")] == ["g0 image", "g1 image"]


def signed(folder: Path, image_id: str) -> InForce:
    """Return a signed list of parts that names the image with that id."""
    key = Ed25519PrivateKey.generate()
    (folder / "parts.json").write_bytes(seal(Parts(fleet="f", number=1, image={REFERENCE: (image_id,)}), key))
    return InForce(folder / "parts.json", authority=key.public_key(), fleet="f")


async def test_an_image_that_is_not_signed_is_left_before_any_of_it_is_loaded(tmp_path: Path) -> None:
    """A false member's image of the right name is refused, counted, and the next member's is taken."""
    other = b"a stranger's layer"
    stranger = Peer(layout=layout(config(other), other), blobs=[config(other), other])
    good = Peer(layout=layout(config(LAYER), LAYER), blobs=[config(LAYER), LAYER])
    named = signed(tmp_path, digest(config(LAYER)))
    transfers, plane, storage = fetching(tmp_path, {"g0": stranger, "g1": good}, named)
    assert (await transfers.bring_image(REFERENCE)).gateway == "g1"
    assert storage.loaded is not None
    assert storage.loaded.id == digest(config(LAYER))
    assert "g0 blob" not in plane.asked[: plane.asked.index("g1 image")]
    assert transfers.refused["unsigned image"] == 1


async def test_an_image_that_nobody_has_signed_comes_from_nobody(tmp_path: Path) -> None:
    """Nothing is loaded; the error says what would have to be signed; nothing of it is left in the spool."""
    good = Peer(layout=layout(config(LAYER), LAYER), blobs=[config(LAYER), LAYER])
    transfers, _, storage = fetching(tmp_path, {"g0": good}, signed(tmp_path, "0" * 64))
    with pytest.raises(IdentityError, match="is not signed"):
        await transfers.bring_image(REFERENCE)
    assert storage.loaded is None
    assert not list((tmp_path / "transfer" / "arriving").iterdir())


async def test_an_image_of_the_right_tag_and_another_id_is_not_as_good_as_here(tmp_path: Path) -> None:
    """What lies under the name already is held against the list too."""
    transfers, _, storage = fetching(tmp_path, {}, signed(tmp_path, "0" * 64))
    storage.loaded = ImageFacts(id="1" * 64, layers=())
    with pytest.raises(IdentityError, match="it is 111111111111"):
        await transfers.bring_image(REFERENCE)


async def test_a_layout_is_small(tmp_path: Path) -> None:
    """What is announced as a layout and larger than one can be is not fetched: it is read whole into memory."""
    transfers, _, _ = fetching(tmp_path, {"g0": Peer(layout=bytes(2**20))})
    with pytest.raises(NotFoundError, match="a layout of 1,048,576 bytes"):
        await transfers.bring_image(REFERENCE)
    assert not list((tmp_path / "transfer" / "arriving").iterdir())
