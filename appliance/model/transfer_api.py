"""Requests and replies of transfers between pools: volumes and images, moved in chunks that a manifest names.

What takes long is answered with `pending` and asked for again. Chunks are raw bytes under a key of their own.
"""

from msgspec import Struct

from appliance.model import Signed, VersionVector

DIGEST_BYTES = 32


class Manifest(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One thing that can be fetched in chunks of `chunk_bytes` (the last may be shorter)."""

    kind: str
    """`volume`: a tar archive of its files. `image`: an `ImageLayout` as JSON. `blob`: a part that a layout names."""
    name: str
    """The volume's name, the image's reference, or the blob's SHA-256."""
    digest: str
    """`root_digest` of all that follows: the same content in the same chunks has the same one everywhere."""
    size_bytes: int
    chunk_bytes: int
    chunks: bytes
    """SHA-256 of each chunk, 32 bytes each, in order."""
    version: VersionVector = {}
    """Of a volume: which state this is."""
    writer: str = ""
    """Of a volume: the gateway that made this state."""

    @property
    def count(self) -> int:
        """How many chunks."""
        return len(self.chunks) // DIGEST_BYTES

    def chunk(self, index: int) -> bytes:
        """SHA-256 of a chunk."""
        return self.chunks[index * DIGEST_BYTES : (index + 1) * DIGEST_BYTES]

    def span(self, index: int) -> tuple[int, int]:
        """Offset and length of a chunk, bytes."""
        offset = index * self.chunk_bytes
        return offset, min(self.chunk_bytes, self.size_bytes - offset)


class ManifestAsk(Struct, frozen=True, kw_only=True):
    """`kind` is `volume`, `image` or `blob`."""

    kind: str
    name: str


class ManifestOffer(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The manifest, or `pending`: it is being made ready. `pack_ms`: what that took."""

    manifest: Manifest | None = None
    pending: bool = False
    pack_ms: float = 0.0


class ImageLayout(Struct, frozen=True, kw_only=True):
    """What an image is made of; each part is a blob. `layers` are SHA-256 of uncompressed layers, the lowest first."""

    reference: str
    image_id: str
    """SHA-256 of its configuration."""
    layers: tuple[str, ...]


class FetchAsk(Signed, frozen=True, kw_only=True):
    """`image_fetch`: bring an image; `gateway` is asked first, empty: any that has it."""

    reference: str
    gateway: str = ""


class Brought(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a transfer did. `wire_bytes` is what came over the network, 0 when nothing had to."""

    what: str
    """`volume/NAME` or `image/REFERENCE`."""
    gateway: str = ""
    """Where it came from; empty when it was here already."""
    size_bytes: int = 0
    wire_bytes: int = 0
    resumed_bytes: int = 0
    """What was here from an earlier try or an older state."""
    duration_ms: float = 0.0


class Progress(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A transfer; put on `gw/{gateway}/transfer/{id}` about twice a second while it goes on, and once at its end."""

    id: str
    what: str
    gateway: str
    """Where it arrives."""
    state: str
    """`waiting`, `preparing`, `moving`, `applying`; at the end `done`, `failed` or `cancelled`."""
    source: str = ""
    done_bytes: int = 0
    size_bytes: int = 0
    rate_mbps: float = 0.0
    """Megabits per second, of content."""
    problem: str = ""


class TransfersAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`transfers`: no parameters."""


class TransferList(Struct, frozen=True, kw_only=True):
    """Transfers to this gateway that are under way or wait."""

    transfers: tuple[Progress, ...]


class CancelAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`transfer_cancel`: which."""

    id: str


class Cancelled(Struct, frozen=True, kw_only=True):
    """Whether there was one to cancel."""

    cancelled: bool
