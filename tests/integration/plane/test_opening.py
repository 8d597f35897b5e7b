"""Opening real Zenoh sessions: endpoints that cannot be had, and a client that outlives its gateway."""

import asyncio
import socket
from datetime import UTC, datetime
from pathlib import Path

import pytest

from appliance.errors import ConfigError, UnreachableError
from appliance.identity.authority import Authority
from appliance.model.roles import Role
from appliance.plane.session import Message, Session
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


async def test_a_port_in_use_is_named(free_port: int) -> None:
    """Listening on a port in use is a ConfigError that names the endpoint and what to do."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", free_port))
        holder.listen()
        with pytest.raises(ConfigError, match=f"{endpoint}.*in use") as caught:
            await Session.open(PlaneConfig(listen=(endpoint,)), "f")
    assert "plane.listen" in caught.value.remedy


async def test_an_address_of_another_machine_is_named(tmp_path: Path) -> None:
    """Listening on an address that is not ours is a ConfigError that names it."""
    keys = tmp_path / "keys.pem"
    Authority.create(tmp_path / "authority", "f", datetime.now(UTC)).issue(Role.GATEWAY, "gw-1", out=keys)
    with pytest.raises(ConfigError, match="no such address"):
        await Session.open(PlaneConfig(listen=("tls/192.0.2.1:7447",), keys=str(keys)), "f")


async def test_a_client_without_gateway_says_so(free_port: int) -> None:
    """A client whose endpoints do not answer gets an UnreachableError that names them."""
    config = PlaneConfig(mode="client", connect=(f"tcp/127.0.0.1:{free_port}",), connect_timeout_s=0.2)
    with pytest.raises(UnreachableError, match=str(free_port)):
        await Session.open(config, "f")


async def test_a_client_comes_back_to_a_restarted_gateway(free_port: int) -> None:
    """A client outlives its gateway: when one listens there again, it is linked again by itself."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    server = await Session.open(PlaneConfig(listen=(endpoint,)), "f")
    client = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "f")
    seen: list[Message] = []
    client.subscribe("swiftbot/f/x", seen.append)
    await server.close()
    server = await Session.open(PlaneConfig(listen=(endpoint,)), "f")
    while not seen:
        server.put("swiftbot/f/x", b"back")
        await asyncio.sleep(0.02)
    await client.close()
    await server.close()
