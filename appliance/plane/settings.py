"""What an operator may set about the plane, each default with its reason."""

import ipaddress
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from msgspec import Struct, field

from appliance.errors import ConfigError, PayloadError
from appliance.model.keys import check_name

_WITH_PORT = frozenset({"tcp", "udp", "tls", "quic", "ws"})
_PROTOCOLS = _WITH_PORT | {"unixsock-stream", "serial"}


class PlaneConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Zenoh session, ring and store of one process."""

    mode: Literal["peer", "client", "router"] = "peer"
    """`peer`: a few gateways, full mesh by gossip. `client`: everybody else, and the gateways of a fleet of more than
    about thirty, which link to one of the routers in `connect` (`swiftbot router`). `router`: routes for clients."""
    listen: tuple[str, ...] = ()
    """Endpoints to accept links on, such as `tls/0.0.0.0:7447`; empty: accept none. Without `keys` only on the
    loopback, such as `tcp/127.0.0.1:7447`; with them `tls` or `quic`."""
    keys: str = ""
    """File with private key and certificate of this process, as `swiftbot keys issue` writes it. Every link is
    authenticated by both sides then, and each role is held to what docs/keyspace.md says of it. Empty: links within
    this machine only, on which everybody may do everything."""
    roster: str = ""
    """The authority's roster: which robots there are, and which certificates are revoked. Empty: `roster.json` in the
    folder of `keys`."""
    parts: str = ""
    """The authority's list of parts: which images, skills and models may be fetched, loaded and run. Empty:
    `parts.json` in the folder of `keys`. Without keys nothing is checked."""
    connect: tuple[str, ...] = ()
    """Endpoints to keep linked to: of routers, or of gateways that name nobody in `connect` themselves. Gossip finds
    the others, but a single cut link is redialled only where it is named. Gateways that know each other belong into
    `peers`."""
    peers: dict[str, str] = field(default_factory=dict[str, str])
    """All gateways of a fleet of peers, this one among them, by `id`: the endpoint under which the others reach each,
    as in `{gw-1 = "tls/10.0.0.1:7447", gw-2 = "tls/10.0.0.2:7447"}`. The same table in each of them: of each two, one
    dials the other, so that a standstill of either cannot mix up two links between them."""
    replicas: int = 3
    """Copies of a record, the owner's among them: two gateways may die at once without losing one (design: r = 3)."""
    virtual_nodes: int = 32
    """Points of each gateway on the ring: shares within about 20 % of each other, and still cheap to compute."""
    voters: tuple[str, ...] = ()
    """Gateways that grant leases by majority, the same list everywhere; empty: there are no leases.
    Named and not learned: two parts of a fleet that do not see each other must agree on what a majority is."""
    find_successors: int = 5
    """How many successors of hash(image) are asked for containers (paper: k = 5)."""
    lease_ms: int = 1000
    """A link silent for so long is dead. 1 s: a frozen gateway is noticed in about 0.75 s; Zenoh's own is 10 s."""
    max_payload_bytes: int = 8 * 2**20
    """Larger messages are refused, in and out: a picture fits, a mistake does not exhaust the memory."""
    max_record_bytes: int = 4 * 2**20
    """Largest value of a record; it must still fit into a payload after base64 (4/3) beside its version."""
    connect_timeout_s: float = 3.0
    """How long a client looks for its first endpoint before it says that none answers. Peers never stop looking."""
    join_wait_s: float = 0.5
    """How long a starting gateway waits for its first link before it concludes that it is the first one up."""
    replica_timeout_s: float = 0.3
    """How long an owner waits for a slow replica; what it misses is repaired by anti-entropy."""
    write_timeout_s: float = 5.0
    """How long a write looks for a reachable owner: well over detection (1 s) and takeover."""
    anti_entropy_s: float = 10.0
    """Interval of comparing digests with the other replicas while nothing changes; a comparison costs one hash."""
    tombstone_hours: float = 24.0
    """How long a removal is remembered. A gateway away for longer may bring a removed record back."""
    coalesce_ms: int = 20
    """Facts changed within this time are published together: a burst of container changes is one message each."""
    coalesce_most_ms: int = 200
    """A fact that changes often and that nobody asks for is published this often; one that is asked for, the sooner.
    Less than the paper's 500 ms, with which containers are missed. In a fleet of more than twenty it grows with N."""
    queue_messages: int = 20_000
    """Bound of each queue between Zenoh and the event loop; beyond it messages are dropped and counted."""
    queue_bytes: int = 128 * 2**20
    """The same in bytes."""
    backlog_s: float = 10.0
    """How long what was put is kept for a recorder that was not linked at that moment: it restarts in 2 s, and a link
    that stood still is reopened within 3 s."""
    backlog_bytes: int = 8 * 2**20
    """Bound of the same in memory; 0: nothing is kept, and what a recorder misses is only counted."""
    concurrent_queries: int = 256
    """Queries answered at once per served key; more are refused with the reason."""

    def check(self) -> None:
        """Raise ConfigError when a setting cannot work."""
        peers = tuple(self.peers.values())
        for name, endpoints in (("listen", self.listen), ("connect", self.connect), ("peers", peers)):
            for endpoint in endpoints:
                protocol, slash, address = endpoint.partition("/")
                if not slash or protocol not in _PROTOCOLS or not address:
                    raise ConfigError(
                        f"plane.{name}: {endpoint!r} is not an endpoint", remedy="write it like tls/192.168.1.10:7447"
                    )
                if protocol in _WITH_PORT:
                    _check_port(name, endpoint, address)
        if self.mode == "client" and not self.connect:
            raise ConfigError("plane.connect is empty", remedy="a client needs an endpoint of a gateway or router")
        if self.mode == "client" and self.listen:
            raise ConfigError(
                "plane.listen is set, but a client accepts no links", remedy="empty it, or set plane.mode to peer"
            )
        self._check_peers()
        for name in self.voters:
            try:
                check_name(name, "gateway")
            except PayloadError as error:
                raise ConfigError(f"plane.voters: {error}", remedy="name gateways by their ids") from error
        if len(set(self.voters)) < len(self.voters):
            raise ConfigError("plane.voters names a gateway twice", remedy="name each once")
        for name, least in _LEAST.items():
            if getattr(self, name) < least:
                raise ConfigError(f"plane.{name} is {getattr(self, name)}", remedy=f"at least {least}")
        if self.max_record_bytes * 4 // 3 + 65_536 > self.max_payload_bytes:
            raise ConfigError(
                f"plane.max_record_bytes {self.max_record_bytes:,} does not fit into plane.max_payload_bytes "
                f"{self.max_payload_bytes:,} once encoded",
                remedy="keep it under 0.7 of max_payload_bytes",
            )

    def check_links(self) -> None:
        """Raise ConfigError for a link that would be neither authenticated nor within this machine."""
        peers = tuple(self.peers.values())
        for name, endpoints in (("listen", self.listen), ("connect", self.connect), ("peers", peers)):
            for endpoint in endpoints:
                self._check_link(name, endpoint)

    def _check_link(self, name: str, endpoint: str) -> None:
        if self.keys:
            if endpoint.partition("/")[0] not in AUTHENTICATED:
                raise ConfigError(
                    f"plane.{name}: {endpoint!r} carries no certificates, and plane.keys is set",
                    remedy=f"write tls/{endpoint.partition('/')[2]}",
                )
        elif not is_local(endpoint):
            raise ConfigError(
                f"plane.{name}: {endpoint!r} is beyond this machine, and plane.keys is not set: "
                "anybody who reaches it could command every robot",
                remedy="`swiftbot keys init` and `swiftbot keys issue gateway NAME --host ADDRESS` make keys; or use "
                "127.0.0.1",
            )

    @property
    def parts_file(self) -> Path:
        """Where the list of parts is; of no meaning without keys."""
        return Path(self.parts or Path(self.keys).parent / "parts.json").expanduser()

    @property
    def roster_file(self) -> Path:
        """Where the roster is; of no meaning without keys."""
        return Path(self.roster or Path(self.keys).parent / "roster.json").expanduser()

    def _check_peers(self) -> None:
        if not self.peers:
            return
        for name in self.peers:
            try:
                check_name(name, "gateway")
            except PayloadError as error:
                raise ConfigError(f"plane.peers: {error}", remedy="name gateways by their ids") from error
        if self.mode != "peer":
            raise ConfigError(
                f"plane.peers is set, but plane.mode is {self.mode}", remedy="name routers or gateways in plane.connect"
            )
        if not self.listen:
            raise ConfigError(
                "plane.peers is set, but plane.listen is empty",
                remedy="some of them dial this one: listen on the endpoint that its own entry names",
            )
        if len(set(self.peers.values())) < len(self.peers):
            raise ConfigError("plane.peers has an endpoint twice", remedy="each gateway has one of its own")
        for name, endpoint in self.peers.items():
            protocol, _, address = endpoint.partition("/")
            host, _, port = address.rpartition(":")
            if protocol in _WITH_PORT and (host in _ANY or port == "0"):
                raise ConfigError(
                    f"plane.peers: {endpoint!r} of {name} is nothing that can be dialled",
                    remedy="write the address and port under which the others reach it",
                )
            if endpoint in self.connect:
                raise ConfigError(
                    f"plane.connect names {endpoint}, which {name} has in plane.peers",
                    remedy="remove it from plane.connect: of the two one dials the other already",
                )

    def check_own(self, gateway: str) -> None:
        """Raise ConfigError when the table of `peers` is not one that this gateway can go by."""
        if self.peers and gateway not in self.peers:
            raise ConfigError(
                f"plane.peers lacks this gateway, {gateway}; it has {', '.join(sorted(self.peers))[:200]}",
                remedy="name each gateway by its id, this one too, the same in all of them",
            )


AUTHENTICATED = frozenset({"tls", "quic"})
"""Protocols that carry certificates of both sides."""


def is_local(endpoint: str) -> bool:
    """Whether a link stays within this machine, as far as the endpoint says."""
    protocol, _, address = endpoint.partition("/")
    if protocol not in _WITH_PORT:
        return protocol == "unixsock-stream"
    host = (urlsplit(f"//{address}").hostname or "").partition("%")[0]
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def dialled_here(endpoint: str) -> str:
    """Where what listens on an endpoint is dialled on this machine: on the loopback, if it listens on any address."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in _WITH_PORT or host not in _ANY:
        return endpoint
    return f"{protocol}/{'[::1]' if host == '[::]' else '127.0.0.1'}:{port}"


_ANY = frozenset({"0.0.0.0", "[::]", "*", ""})  # noqa: S104 - hosts to listen on that nobody can dial
_LEAST: dict[str, float] = {
    "replicas": 1,
    "virtual_nodes": 1,
    "find_successors": 1,
    "lease_ms": 100,
    "max_payload_bytes": 131_072,
    "max_record_bytes": 1024,
    "connect_timeout_s": 0,
    "join_wait_s": 0,
    "replica_timeout_s": 0.01,
    "write_timeout_s": 0.1,
    "anti_entropy_s": 0.1,
    "tombstone_hours": 0.01,
    "coalesce_ms": 0,
    "coalesce_most_ms": 1,
    "queue_messages": 100,
    "queue_bytes": 2**20,
    "backlog_s": 0,
    "backlog_bytes": 0,
    "concurrent_queries": 1,
}


def _check_port(name: str, endpoint: str, address: str) -> None:
    try:
        port = urlsplit(f"//{address}").port
    except ValueError:
        port = None
    if port is None:
        raise ConfigError(f"plane.{name}: {endpoint!r} has no valid port", remedy="write it like tls/192.168.1.10:7447")
