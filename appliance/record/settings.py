"""How the recorder writes: figures chosen so that a killed recorder loses about half a second, not a chunk.

Measured with the pure-Python writer killed after 3 s at 1,000 messages/s: 1 MiB chunks leave nothing readable,
64 KiB chunks lose 7 %, 64 KiB with a flush every 0.5 s loses that half second.
"""

from pathlib import Path

from msgspec import Struct

from appliance.errors import ConfigError, PayloadError
from appliance.model.keys import check_name
from appliance.record.retention import Budget


class RecordConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a recorder. Sizes in bytes, times in seconds."""

    directory: str = "/var/lib/swiftbot/log"
    """Where the log files go; made when absent."""
    keys: str = ""
    """File with the recorder's keys (`swiftbot keys issue recorder NAME`); empty: the gateway's, `plane.keys`."""
    mode: str = "all"
    """`all`: everything is written. `incidents`: the last `before_s` seconds are held in memory and written when
    something goes wrong (a task fails, a failsafe, a soft stop, `swiftbot log trigger`), with what follows. For a site
    where nothing happens on most days and disks are small; what a power cut takes then is what waited in memory."""
    before_s: float = 30.0
    """Of `incidents`: how far back the log goes. A failed attempt and its repetitions take half a minute."""
    after_s: float = 30.0
    """Of `incidents`: how long it goes on after the last incident."""
    ring_bytes: int = 64 * 2**20
    """Of `incidents`: what the messages held may take; the oldest go first. 30 s of a busy fleet with cameras."""
    device_name: str = ""
    """By which Foxglove files recordings; empty: fleet and recorder's name."""
    device_id: str = ""
    """Foxglove's own id of the device (`dev_...`), where it has been given one; empty: only the name is given."""
    name: str = "recorder"
    """The recorder's name on the network and in file names; different for each recorder of a fleet."""
    chunk_bytes: int = 64 * 1024
    """A chunk is the unit that survives a kill; see above."""
    compression: str = "zstd"
    """`zstd`, `lz4` or `none`: telemetry shrinks about fivefold with zstd at its default level."""
    flush_s: float = 0.5
    """Most that a kill loses."""
    fsync: bool = True
    """After each flush: what was flushed survives a power cut too."""
    rotate_bytes: int = 256 * 2**20
    """A new file at this size: a file stays small enough to copy and open, its index small in memory."""
    rotate_s: float = 1800.0
    """A new file after this long."""
    max_channels: int = 10_000
    """A new file after this many channels (MCAP has room for 65,535)."""
    free_bytes: int = 256 * 2**20
    """Writing stops while the disk has less free than this, and goes on at an eighth more."""
    total_bytes: int = 8 * 2**30
    """What this recorder's files may take together; at each new file the oldest go, pinned ones never. 0: no limit.
    A local fleet of three gateways and two robots at work writes 17 to 29 MB an hour: this is some twelve days."""
    days: float = 90.0
    """How long a file is kept after it was written to, pinned ones for good. 0: as long as there is room."""
    warn_hours: float = 24.0
    """So long before the oldest log goes there is an alert: copy or pin what is to be kept. 0: none."""
    queue_messages: int = 60_000
    """Messages waiting for the writer thread; more are dropped, counted and written down as a gap. A disk that takes a
    second to sync is no loss then, at all that a fleet can say."""
    queue_bytes: int = 64 * 2**20
    """The same bound in payload bytes: pictures are larger than telemetry."""
    message_bytes: int = 16 * 2**20
    """A larger payload is dropped, counted and written down as a gap."""
    status_s: float = 1.0
    """How often the recorder puts its status."""

    def check(self) -> None:
        """Raise ConfigError for values that cannot work, naming the key."""
        try:
            check_name(self.name, "record.name")
        except PayloadError as error:
            raise ConfigError(error.message, remedy=error.remedy) from error
        if self.compression not in ("zstd", "lz4", "none"):
            raise ConfigError(f"record.compression is {self.compression!r}", remedy="choose one of: zstd, lz4, none")
        for key in (
            "chunk_bytes",
            "rotate_bytes",
            "queue_messages",
            "queue_bytes",
            "message_bytes",
            "max_channels",
            "ring_bytes",
        ):
            if getattr(self, key) < 1:
                raise ConfigError(f"record.{key} is {getattr(self, key)}", remedy="give a number above 0")
        if self.max_channels > 60_000:
            raise ConfigError(
                f"record.max_channels is {self.max_channels}", remedy="give at most 60000: MCAP numbers 65,535"
            )
        if self.mode not in ("all", "incidents"):
            raise ConfigError(f"record.mode is {self.mode!r}", remedy="choose one of: all, incidents")
        for key in ("flush_s", "rotate_s", "status_s", "before_s", "after_s"):
            if not getattr(self, key) > 0:
                raise ConfigError(f"record.{key} is {getattr(self, key)}", remedy="give a time above 0 seconds")
        if self.total_bytes and self.total_bytes < 2 * self.rotate_bytes:
            raise ConfigError(
                f"record.total_bytes is {self.total_bytes}, less than two files of record.rotate_bytes",
                remedy="raise it, lower rotate_bytes, or give 0 for no limit",
            )
        for key in ("days", "warn_hours"):
            if not 0 <= getattr(self, key) <= 36_500:
                raise ConfigError(f"record.{key} is {getattr(self, key)}", remedy="give 0 (none) to 36500")
        if self.free_bytes < 0:
            raise ConfigError(f"record.free_bytes is {self.free_bytes}", remedy="give 0 or more")

    @property
    def budget(self) -> Budget:
        """What files may take when a new one begins, which needs room too."""
        return Budget(
            most_bytes=self.total_bytes - self.rotate_bytes if self.total_bytes else None,
            most_s=self.days * 86_400 if self.days else None,
        )

    @property
    def folder(self) -> Path:
        """The directory as a path, `~` expanded."""
        return Path(self.directory).expanduser()
