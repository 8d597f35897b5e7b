"""Who gets a link to a gateway with keys: holders of a good certificate of its fleet, and nobody else."""

import asyncio
import socket
import ssl
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest
import zenoh
from secured import FLEET, GATEWAYS, Secured, secured, until

from appliance.errors import ConfigError, IdentityError, UnreachableError
from appliance.identity.authority import Authority
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.model.roles import Role
from appliance.plane import link
from appliance.plane.client import PlaneClient
from appliance.plane.node import Plane, run_router
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


def plain(endpoint: str, authority: Path, **more: object) -> zenoh.Config:
    """Return the configuration of a client that has no certificate, whatever it knows otherwise."""
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 700,
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "transport/link/tls/root_ca_certificate": str(authority),
        "transport/link/tls/enable_mtls": False,
        **more,
    }
    for key, value in settings.items():
        config.insert_json5(key, msgspec.json.encode(value).decode())
    return config


async def refused(config: zenoh.Config) -> bool:
    """Whether no session comes about."""
    try:
        session = await asyncio.to_thread(zenoh.open, config)
    except zenoh.ZError:
        return True
    await asyncio.to_thread(session.close)
    return False


@pytest.mark.parametrize("protocol", ["tls", "quic"])
async def test_without_a_certificate_there_is_no_link(
    protocol: str, tmp_path: Path, free_ports: Callable[..., list[int]]
) -> None:
    """Over neither protocol (quic has let such clients in before, zenoh issue 771); with one there is."""
    async with secured(tmp_path, free_ports(2), protocol=protocol) as fleet:
        endpoint, authority = fleet.endpoints["g0"], fleet.authority.folder / "authority.crt"
        assert await refused(plain(endpoint, authority))
        assert await refused(plain(endpoint.replace(protocol, "tcp"), authority))
        client = await PlaneClient.open(fleet.client(Role.VIEWER), fleet=FLEET)
        assert client.members() == set(GATEWAYS)
        await client.close()


@pytest.mark.parametrize("protocol", ["tls", "quic"])
async def test_without_a_certificate_not_one_key_is_readable_or_writable(
    protocol: str, tmp_path: Path, free_ports: Callable[..., list[int]]
) -> None:
    """By one who dials and listens as a peer: each key is put, subscribed to, asked and shown as alive."""
    keys = Keys(FLEET)
    async with secured(tmp_path, free_ports(2), protocol=protocol) as fleet:
        own: set[str] = set()
        fleet.planes["g0"].session.subscribe(keys.everything, lambda message: own.add(message.key))
        endpoints = list(fleet.endpoints.values())
        around = {
            "mode": "peer",
            "connect/endpoints": [*endpoints, *(each.replace(protocol, "tcp") for each in endpoints)],
            "connect/exit_on_failure": False,
            "listen/endpoints": ["tcp/127.0.0.1:0"],
        }
        config = plain(endpoints[0], fleet.authority.folder / "authority.crt", **around)
        raw = await asyncio.to_thread(zenoh.open, config)
        heard: set[str] = set()
        subscriber = raw.declare_subscriber(
            "**", lambda sample: heard.add(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
        )
        tokens = [raw.liveliness().declare_token(keys(keyspace.GATEWAY_ALIVE, "evil"))]
        for topic in keyspace.TOPICS:
            if topic.form not in ("token", "query"):
                raw.put(keys(topic, *(f"evil-{field}" for field in topic.fields)), b"{}")
        questions = [keys(keyspace.RPC, "g0", verb.name) for verb in keyspace.VERBS]
        asked = [raw.get(each, payload=b"{}", timeout=1.0) for each in (*questions, f"{keys.root}/**", "@/**")]
        fleet.planes["g1"].session.put(keys(keyspace.STATUS, "g1"), b"{}")
        answers = [reply for each in asked for reply in await asyncio.to_thread(list, each)]
        assert not [each for each in answers if each.ok is None or not str(each.ok.key_expr).startswith("@")]
        assert heard == set()
        assert list(raw.info.peers_zid()) == list(raw.info.routers_zid()) == []
        await until(lambda: keys(keyspace.STATUS, "g1") in own)
        assert not [each for each in own if "evil" in each]
        assert {frozenset(plane.members()) for plane in fleet.planes.values()} == {frozenset(GATEWAYS)}
        del subscriber, tokens
        await asyncio.to_thread(raw.close)


async def test_another_authoritys_certificate_is_none(fleet: Secured, tmp_path: Path) -> None:
    """Though it says the same role, name and fleet; nor does its gateway get a link with those of the fleet."""
    other = Authority.create(tmp_path / "other", FLEET, datetime.now(UTC))
    (tmp_path / "elsewhere").mkdir()
    keys = tmp_path / "elsewhere" / "forged.pem"
    other.issue(Role.GATEWAY, "g1", out=keys)
    own = fleet.authority.folder / "authority.crt"
    forged = {
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/connect_certificate": str(keys),
        "transport/link/tls/connect_private_key": str(keys),
    }
    assert await refused(plain(fleet.endpoints["g0"], own, **forged))
    config = msgspec.structs.replace(fleet.client(Role.VIEWER), keys=str(keys))
    with pytest.raises(UnreachableError, match="nothing answers"):
        await PlaneClient.open(config, fleet=FLEET)


async def test_an_expired_certificate_is_refused_by_both_sides(fleet: Secured, tmp_path: Path) -> None:
    """The one that has it says so before it connects; a gateway refuses it from one that does not look."""
    keys = tmp_path / "old.pem"
    fleet.authority.issue(Role.OPERATOR, "otto", out=keys, days=1, now=datetime.now(UTC) - timedelta(days=3))
    config = msgspec.structs.replace(fleet.client(Role.OPERATOR), keys=str(keys))
    with pytest.raises(IdentityError, match="expired"):
        await PlaneClient.open(config, fleet=FLEET)
    expired = {
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/connect_certificate": str(keys),
        "transport/link/tls/connect_private_key": str(keys),
    }
    assert await refused(plain(fleet.endpoints["g0"], fleet.authority.folder / "authority.crt", **expired))


@pytest.mark.parametrize("role", [role for role in Role if role is not Role.GATEWAY])
async def test_only_gateways_accept_links(fleet: Secured, free_port: int, role: Role) -> None:
    """A process that poses as a gateway with other keys is no gateway to those who dial: TLS refuses it."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    with pytest.raises(IdentityError, match="only gateways accept links"):
        await Session.open(PlaneConfig(listen=(endpoint,), keys=str(fleet.keys(role))), FLEET)
    config = PlaneConfig(listen=(endpoint,), keys=str(fleet.keys(role)))
    credentials = link.read_credentials(config, FLEET)
    false = await asyncio.to_thread(link.open_raw, config, "", credentials)
    try:
        client = msgspec.structs.replace(fleet.client(Role.OPERATOR), connect=(endpoint,))
        with pytest.raises(UnreachableError):
            await PlaneClient.open(client, fleet=FLEET)
    finally:
        await asyncio.to_thread(false.close)


async def test_a_gateway_has_the_keys_of_its_own_id(fleet: Secured, tmp_path: Path, free_port: int) -> None:
    """Those of another gateway, of another fleet, or of a revoked one do not start it."""

    async def start(gateway: str, fleet_name: str = FLEET) -> None:
        config = PlaneConfig(listen=(f"tls/127.0.0.1:{free_port}",), keys=str(fleet.keys(Role.GATEWAY, "g1")))
        await Plane.open(config, fleet=fleet_name, gateway=gateway, data_dir=tmp_path / "data")

    with pytest.raises(IdentityError, match="is of gateway g1, and this is gateway g7"):
        await start("g7")
    with pytest.raises(IdentityError, match="is of fleet f, and this is fleet dock"):
        await start("g1", "dock")
    fleet.authority.revoke(Role.GATEWAY, "g1", why="stolen")
    fleet.hand_out()
    with pytest.raises(IdentityError, match="revoked: stolen"):
        await start("g1")


async def test_a_host_that_the_certificate_does_not_name_is_not_dialled(fleet: Secured) -> None:
    """So an address that is somebody else's by now gets nothing; the remedy says where to look."""
    port = fleet.endpoints["g0"].rpartition(":")[2]
    config = msgspec.structs.replace(fleet.client(Role.VIEWER), connect=(f"tls/127.0.0.2:{port}",))
    with pytest.raises(UnreachableError, match="certificate must name the host"):
        await PlaneClient.open(config, fleet=FLEET)


async def test_what_is_said_on_a_link_is_not_readable(fleet: Secured) -> None:
    """A peer without TLS gets no byte of the fleet's; one that has TLS and no certificate gets no further."""
    host, _, port = fleet.endpoints["g0"].removeprefix("tls/").rpartition(":")

    def listen_in() -> bytes:
        with socket.create_connection((host, int(port)), timeout=2.0) as raw:
            raw.sendall(b"\x05\x00\x01\x09\x40\x00")
            return raw.recv(4096)

    def without_certificate() -> bytes:
        context = ssl.create_default_context(cafile=str(fleet.authority.folder / "authority.crt"))
        with (
            socket.create_connection((host, int(port)), timeout=2.0) as raw,
            context.wrap_socket(raw, server_hostname="localhost") as secure,
        ):
            return secure.recv(4096)

    said = await asyncio.to_thread(listen_in)
    assert b"swiftbot" not in said
    assert len(said) < 16  # an alert of TLS, or nothing
    with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
        await asyncio.to_thread(without_certificate)


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tls/10.0.0.1:7447", "udp/gw-1:1"])
def test_without_keys_links_stay_on_the_machine(endpoint: str) -> None:
    """A gateway listens, and dials, beyond it with keys only; the message has the commands that make them."""
    for config in (PlaneConfig(listen=(endpoint,)), PlaneConfig(connect=(endpoint,))):
        with pytest.raises(ConfigError, match="beyond this machine") as told:
            config.check_links()
        assert "swiftbot keys init" in told.value.remedy
    for local in ("tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:7447", "unixsock-stream//run/s"):
        PlaneConfig(listen=(local,)).check_links()


def test_with_keys_no_link_is_without_certificates() -> None:
    """Not even on the loopback: who reaches it there would be nobody."""
    for config in (
        PlaneConfig(listen=("tcp/127.0.0.1:7447",), keys="k"),
        PlaneConfig(listen=("tls/127.0.0.1:1",), connect=("unixsock-stream//run/s",), keys="k"),
        PlaneConfig(listen=("tls/127.0.0.1:1",), peers={"a": "tls/h:1", "b": "tcp/h:2"}, keys="k"),
    ):
        with pytest.raises(ConfigError, match="carries no certificates"):
            config.check_links()


async def test_a_router_holds_its_clients_to_their_roles(fleet: Secured, tmp_path: Path, free_port: int) -> None:
    """Gateways and people behind it speak through it as they would without; its keys are a gateway's."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    with pytest.raises(IdentityError, match="is of viewer vera, and a router accepts links"):
        await run_router(
            PlaneConfig(listen=(endpoint,), keys=str(fleet.keys(Role.VIEWER))),
            stop=asyncio.Event(),
            ready=lambda _: None,
            alive=lambda: None,
        )
    stop, ready = asyncio.Event(), asyncio.Event()
    keys = fleet.issue(Role.GATEWAY, "router-1")
    routing = asyncio.create_task(
        run_router(
            PlaneConfig(listen=(endpoint,), keys=str(keys)), stop=stop, ready=lambda _: ready.set(), alive=lambda: None
        )
    )
    await ready.wait()
    gateway_keys = fleet.issue(Role.GATEWAY, "g8")
    behind = await Plane.open(
        PlaneConfig(mode="client", connect=(endpoint,), keys=str(gateway_keys)),
        fleet=FLEET,
        gateway="g8",
        data_dir=tmp_path / "g8",
    )
    config = msgspec.structs.replace(fleet.client(Role.VIEWER), connect=(endpoint,))
    client = await PlaneClient.open(config, fleet=FLEET)
    try:
        await until(lambda: client.members() == {"g8"})
        attacker = await asyncio.to_thread(
            link.open_raw, config, "", await asyncio.to_thread(link.read_credentials, config, FLEET)
        )
        token = attacker.liveliness().declare_token(f"swiftbot/{FLEET}/gw/evil/alive")
        answers = list(attacker.get(f"swiftbot/{FLEET}/gw/g8/rpc/dht_digest", payload=b"{}", timeout=1.0))
        assert answers == []
        assert behind.members() == {"g8"}
        token.undeclare()
        await asyncio.to_thread(attacker.close)
    finally:
        await client.close()
        await behind.close()
        stop.set()
        await routing
