"""What can be set of transfers between gateways; the table `transfer` of section `[pool]`."""

from typing import Annotated

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0)]


class TransferConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Volumes and images that move between gateways."""

    chunk_kb: Annotated[int, Meta(ge=16, le=4096)] = 1024
    """What is asked for, checked and compressed at once, KiB: a question each costs about 0.5 ms."""
    window: Annotated[int, Meta(ge=1, le=64)] = 16
    """Chunks on their way at most, for each transfer; fewer where the link is slower (`in_flight_s`)."""
    in_flight_s: Positive = 0.2
    """How many seconds' worth of the measured bandwidth may be on its way: what waits on a slow link is not more."""
    at_once: Annotated[int, Meta(ge=1, le=16)] = 2
    """Transfers to this gateway at once; further ones wait."""
    waiting: Annotated[int, Meta(ge=0, le=1024)] = 16
    """Transfers that may wait; more are refused."""
    serving: Annotated[int, Meta(ge=1, le=256)] = 32
    """Chunks being read and compressed for others at once; more are refused, and asked for again."""
    chunk_timeout_s: Positive = 5.0
    """A chunk not there by then is asked for again, beyond what the measured bandwidth explains."""
    patience_s: Positive = 20.0
    """How long a transfer goes on without any new chunk before it is given up, to be resumed by the next try."""
    prepare_s: Positive = 300.0
    """How long the source may take to make ready what it is asked for: an image of 1 GB takes it 20 s."""
    most_mb: Annotated[int, Meta(ge=1)] = 8192
    """Largest volume or layer that is moved, MB."""
    most_files: Annotated[int, Meta(ge=1)] = 200_000
    """Files in a volume that is moved."""
    spool_mb: Annotated[int, Meta(ge=1)] = 16_384
    """Disk for what arrives, MB, broken transfers included; those touched longest ago go first."""
    cache_mb: Annotated[int, Meta(ge=1)] = 4096
    """Disk for what is kept ready for others, MB: the last state of each volume, layers of images asked for."""
    reserve_mb: Annotated[int, Meta(ge=0)] = 512
    """Disk left free, MB: a transfer that would take it is refused, and a run that writes much into its volumes while
    there is less is ended."""
    backups: Annotated[int, Meta(ge=1, le=64)] = 8
    """Kept states of a volume that lost against another gateway's; beyond it the oldest is removed, and logged."""
    use_wait_s: Positive = 5.0
    """How long a volume's new state waits for the runs that use the old one."""
