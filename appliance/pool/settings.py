"""What can be set of the pool and its transfers; section `[pool]` of a gateway's file, with its table `transfer`."""

from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, Struct, field
from msgspec.structs import replace

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


Percent = Annotated[float, Meta(gt=0, le=100)]


class Weights(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Weights of Score(c, T), together 1 (paper, Algorithm 1)."""

    image: float = 0.5
    """The right image matters most: a merely compatible one has not preloaded this skill."""
    resources: float = 0.3
    volumes: float = 0.2


class PressureConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When the pool gives way to a lack of memory."""

    watch: bool = True
    """Whether it does at all."""
    every_s: Positive = 1.0
    """How often the kernel is asked: reading three small files takes 0.1 ms."""
    some_high: Percent = 10.0
    """Percent of the last 10 s in which some process stood still for want of memory, from which the pool shrinks."""
    full_high: Percent = 5.0
    """The same for all processes at once."""
    low: Annotated[float, Meta(ge=0, le=100)] = 2.0
    """Percent of `some` below which it may grow again."""
    spare_mb: Annotated[int, Meta(ge=0)] = 256
    """Available memory below which the pool shrinks, MB; it grows again from one and a half times as much."""
    shrink: Annotated[float, Meta(gt=0, le=1)] = 0.25
    """Part of what is held that is taken away at once."""
    settle_s: Positive = 3.0
    """How long a step is given to show before the next."""
    calm_s: Positive = 20.0
    """How long it must be calm before the pool may grow by a step."""
    regrow: Annotated[float, Meta(gt=0, le=1)] = 0.125
    """Part of `pool.memory_mb` by which it grows."""
    least_mb: Annotated[int, Meta(ge=0)] = 512
    """What the pool may always hold: two ordinary containers, so that work goes on however slowly."""


PAPER_IDLE_S = 600.0
"""The paper's keep-alive."""


SECCOMP = Path(__file__).with_name("seccomp.json")
"""Podman's default profile (containers-common 0.50) without what makes namespaces and mounts or reads other processes:
for a handler that breaks out of its Python these are the way to the kernel's least tested parts."""


class PoolConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of one gateway's pool."""

    tell_decisions: bool = True
    """Put each selection and eviction with all that it rested on, so that `swiftbot log check` can make it again: about
    1 kB a run."""
    mode: Literal["cold", "local", "federated"] = "federated"
    """`cold`: a fresh container for every run, removed afterwards (the baseline to measure against). `local`: warm
    containers of this gateway only, as in the paper: kept for ten minutes after their last run, the longest idle one
    given up first, none started ahead but the floor; `prewarm`, `keep`, `eviction` and `idle_s` are not looked at.
    `federated`: those of other gateways too, and all policies."""
    capacity: Annotated[int, Meta(ge=1, le=256)] = 8
    """Containers at most; each has a process (8 to 30 MB) and a conmon (2 MB) of its own."""
    memory_mb: Annotated[int, Meta(ge=64)] = 4096
    """Memory of all containers together, by what they are allowed, not by what they use."""
    floor: dict[str, Annotated[int, Meta(ge=0, le=64)]] = field(default_factory=lambda: {"base": 2, "vision": 1})
    """Containers of each image kept ready: two so that a second subtask finds one while the first is replaced.
    One whose run is over before a new one could be there counts as ready."""
    cpu: Positive = 1.0
    """Cores of a container whose skills ask for less."""
    container_memory_mb: Annotated[int, Meta(ge=32)] = 256
    """Memory of a container whose skills ask for less."""
    pids: Annotated[int, Meta(ge=8)] = 128
    """Processes in a container: an ffmpeg has some 20 threads."""
    user_processes: Annotated[int, Meta(ge=0)] = 2048
    """Where pids cannot be limited by cgroup: processes of the whole user beyond which a run cannot fork."""
    tmp_mb: Annotated[int, Meta(ge=4)] = 64
    """Size of a container's /tmp, in memory."""
    runtime: str = ""
    """OCI runtime; empty: Podman's own with cgroup v2, runc with v1, where crun refuses."""
    podman_url: str = ""
    """API socket as `unix:///path`; empty: $XDG_RUNTIME_DIR/podman/podman.sock."""
    folders: dict[str, str] = field(default_factory=dict[str, str])
    """Folders of this machine for skills that name them in `folders`, by name; they are mounted read-only. One that is
    not given here is `folders/NAME` in `data_dir`."""
    seccomp_profile: str = ""
    """Path of a seccomp profile; empty: the one that comes with the program, tighter than Podman's (no namespaces,
    mounts, ptrace); `podman`: Podman's own."""
    base_image: str = ""
    """Base of a reachable registry for the images' Containerfiles; empty: made from the host's Debian packages."""

    theta_match: float = 0.6
    """A remote container needs at least this score (paper: theta_match)."""
    gamma: float = 0.5
    """A remote container may cost at most this part of a cold start (paper: gamma)."""
    weights: Weights = field(default_factory=Weights)
    cold_ms: Positive = 500.0
    """What a cold start is thought to cost before one was measured here."""
    remote_timeout_s: Positive = 0.3
    """How long other gateways are asked for containers; beyond it a cold start would be quicker."""

    lease_s: Positive = 5.0
    """A selected container that is not used by then is free again."""
    queue: Annotated[int, Meta(ge=0)] = 32
    """Runs that may wait for a container when all are busy; more are refused."""
    queue_wait_s: Positive = 30.0
    """How long they wait."""
    start_timeout_s: Positive = 20.0
    """From create to the runner's answer; a loaded two-core machine has been seen to take 3 s."""
    starts_at_once: Annotated[int, Meta(ge=1, le=16)] = 2
    """Containers started at the same time in the background."""
    cancel_grace_s: Positive = 2.0
    """From asking a run to end to ending it."""
    probe_s: Positive = 3.0
    """How often each runner is pinged."""
    probe_timeout_s: Positive = 2.0
    probe_failures: Annotated[int, Meta(ge=1)] = 2
    """Pings in a row without answer after which a container is replaced."""
    eviction: Literal["greedy-dual", "lru", "learned"] = "learned"
    """Who is given up when room is needed: `learned` predicts when each is used next, and lets Greedy-Dual decide while
    it has seen too little or has lately been the worse. In simulation it has up to a quarter fewer cold starts than
    Greedy-Dual and is hardly ever behind it (docs/benchmarks.md, Policies)."""
    prewarm: tuple[Literal["hints", "histogram", "rate"], ...] = ("hints", "histogram")
    """What containers are started ahead for, beside the floor: `hints`: what plans have announced; `histogram`: the
    idle times of an image that is wanted regularly say that it is due; `rate`: arrival rate × service time, to
    `hit_target`, where there is room. Without `rate` by default: in simulation it holds more memory idle and on
    mixed loads has more cold starts, for what it starts crowds out what would have been used."""
    hit_target: Annotated[float, Meta(gt=0, lt=1)] = 0.95
    """Part of the runs of an often used image that shall find a warm container, by `rate`."""
    keep: Literal["fixed", "histogram", "worth"] = "worth"
    """How long an idle container is kept while there is room: `fixed`: for `idle_s`; `histogram`: until the 99th
    percentile of its image's idle times, or not at all before the 5th when that is long; `worth`: while the cold start
    it saves is worth its memory until it is expected to be used. `idle_s` where they cannot tell. By worth, in
    simulation, there are fewer cold starts than by a fixed time with less memory idle."""
    idle_s: Positive = 600.0
    """How long a container beyond the floor is kept idle (`fixed`), or how far ahead its next use may be expected if it
    is of usual size and start cost (`worth`): the usual 10 minutes; an hour makes little difference in simulation."""
    max_runs: Annotated[int, Meta(ge=1)] = 200
    """A container is replaced after so many runs."""
    max_growth_mb: Positive = 64.0
    """A container whose runner has grown by so much since its start is replaced."""
    bad_starts: Annotated[int, Meta(ge=1)] = 3
    """Failed starts in a row after which an image is left alone for a while."""
    quarantine_s: Positive = 60.0
    """For how long."""
    reconnect_s: Positive = 1.0
    """First pause before a Podman that is not there is tried again; doubles up to 30 s."""
    pressure: PressureConfig = field(default_factory=PressureConfig)
    transfer: TransferConfig = field(default_factory=TransferConfig)
    """How volumes and images come from other gateways."""

    def seccomp_file(self) -> str:
        """Return the path of the seccomp profile for containers; empty: Podman's own."""
        return "" if self.seccomp_profile == "podman" else self.seccomp_profile or str(SECCOMP)

    def baseline(self) -> "PoolConfig":
        """Return the settings that the policies are to go by: with mode `local` those of the paper."""
        if self.mode != "local":
            return self
        return replace(self, prewarm=(), keep="fixed", eviction="lru", idle_s=PAPER_IDLE_S)
