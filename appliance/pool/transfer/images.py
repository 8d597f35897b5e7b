"""Images that come from another gateway: fetch the layers that are not here, build an OCI archive, load and verify.

No registry is needed: whoever has an image gives it. Layers travel uncompressed by their SHA-256, compressed chunk
by chunk on the way, so a layer is the same thing on every gateway, and one that is here is never asked for.
"""

import hashlib
import io
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from appliance.errors import PayloadError
from appliance.pool.transfer.api import ImageLayout
from appliance.pool.transfer.manifest import is_digest

MOST_LAYERS = 128
MOST_CONFIG = 4 * 2**20
_COPY = 2**20
_OCI = "application/vnd.oci.image"


def check_layout(layout: ImageLayout, reference: str) -> None:
    """Check what a gateway says an image is made of; PayloadError when it cannot be."""
    digests = (layout.image_id, *layout.layers)
    if layout.reference != reference or len(layout.layers) > MOST_LAYERS or not all(map(is_digest, digests)):
        raise PayloadError(f"image {reference[:100]} was asked for, and something else announced")


def check_config(layout: ImageLayout, config: Path) -> bytes:
    """Return an image's configuration if it is the one announced, with the layers announced; PayloadError otherwise."""
    if config.stat().st_size > MOST_CONFIG:
        raise PayloadError(f"image {layout.reference} has a configuration of {config.stat().st_size:,} bytes")
    data = config.read_bytes()
    found: Any = None
    if hashlib.sha256(data).hexdigest() == layout.image_id:
        try:
            found = msgspec.json.decode(data, type=dict[str, Any]).get("rootfs", {}).get("diff_ids")
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, AttributeError):
            found = None
    if found != [f"sha256:{each}" for each in layout.layers]:
        raise PayloadError(f"image {layout.reference} is not made of what was announced")
    return data


def content_digest(path: Path) -> str:
    """SHA-256 of a file. Blocks."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def archive(layout: ImageLayout, config: bytes, blobs: Mapping[str, Path], sizes: Mapping[str, int]) -> Iterator[bytes]:
    """An OCI archive, piece by piece, with those layers that are in `blobs`. Blocks while it reads them.

    Args:
        layout: what the image is made of.
        config: its configuration.
        blobs: the layers that are not in Podman's storage yet.
        sizes: of all layers that are known; of one that is in the storage it does not matter.
    """
    manifest = msgspec.json.encode(
        {
            "schemaVersion": 2,
            "mediaType": f"{_OCI}.manifest.v1+json",
            "config": _descriptor(f"{_OCI}.config.v1+json", layout.image_id, len(config)),
            "layers": [_descriptor(f"{_OCI}.layer.v1.tar", each, sizes.get(each, 0)) for each in layout.layers],
        }
    )
    digest = hashlib.sha256(manifest).hexdigest()
    named = _descriptor(f"{_OCI}.manifest.v1+json", digest, len(manifest))
    index = {
        "schemaVersion": 2,
        "manifests": [named | {"annotations": {"org.opencontainers.image.ref.name": layout.reference}}],
    }
    yield from _member("oci-layout", b'{"imageLayoutVersion":"1.0.0"}')
    yield from _member("index.json", msgspec.json.encode(index))
    yield from _member(f"blobs/sha256/{digest}", manifest)
    yield from _member(f"blobs/sha256/{layout.image_id}", config)
    for each, path in blobs.items():
        size = path.stat().st_size
        yield _header(f"blobs/sha256/{each}", size)
        with path.open("rb") as file:
            while data := file.read(_COPY):
                yield data
        yield bytes(-size % tarfile.BLOCKSIZE)
    yield bytes(2 * tarfile.BLOCKSIZE)


def _descriptor(media_type: str, digest: str, size: int) -> dict[str, Any]:
    return {"mediaType": media_type, "digest": f"sha256:{digest}", "size": size}


def _header(name: str, size: int) -> bytes:
    info = tarfile.TarInfo(name)
    info.size, info.mode = size, 0o644
    return info.tobuf(tarfile.GNU_FORMAT)


def _member(name: str, data: bytes) -> Iterator[bytes]:
    out = io.BytesIO()
    out.write(_header(name, len(data)))
    out.write(data)
    out.write(bytes(-len(data) % tarfile.BLOCKSIZE))
    yield out.getvalue()
