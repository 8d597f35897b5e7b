"""What gateways ask of each other to move things: the request and reply structs of the verbs.

    transfer_manifest   ManifestAsk -> ManifestOffer    what a volume or blob is made of
    image_layout        ImageAsk -> ImageOffer          what an image is made of
    image_fetch         FetchAsk -> Brought             have a gateway bring an image to itself
    transfers           TransfersAsk -> TransferList    transfers to a gateway that are under way
    transfer_cancel     CancelAsk -> Cancelled          end one of them

What takes long is answered with `pending` and asked for again. Chunks are raw bytes under a key of their own.
"""

from msgspec import Struct

from appliance.model import Signed
from appliance.pool.transfer.manifest import Manifest


class ManifestAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`kind` is `volume` or `blob`."""

    kind: str
    name: str


class ManifestOffer(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The manifest, or `pending`: it is being made ready. `pack_ms`: what that took."""

    manifest: Manifest | None = None
    pending: bool = False
    pack_ms: float = 0.0


class ImageAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An image by its full reference."""

    reference: str


class ImageLayout(Struct, frozen=True, kw_only=True):
    """What an image is made of; each part is a blob. `layers` are SHA-256 of uncompressed layers, the lowest first."""

    reference: str
    image_id: str
    """SHA-256 of its configuration."""
    layers: tuple[str, ...]


class ImageOffer(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The layout, or `pending`: its blobs are being made ready."""

    layout: ImageLayout | None = None
    pending: bool = False


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
