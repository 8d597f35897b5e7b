"""Signed parts on a real gateway with keys: an image that the list does not name is refused, until it is signed."""

import asyncio
from pathlib import Path

import pytest
from fleets import fleet_in

from appliance.client import FleetClient
from appliance.errors import IdentityError
from appliance.identity import certificates, parts
from appliance.identity.authority import Authority
from workshop.local_fleet import keys_folder

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]


async def test_an_image_that_is_signed_no_more_is_refused(tmp_path: Path) -> None:
    """The gateway goes by the new list without a restart; status, alert and counter say what it refuses."""
    async with fleet_in(tmp_path, gateways=1, mavlink=0, zenoh=0, secured=True) as state:
        authority = Authority.load(keys_folder(Path(state.directory)))
        file = authority.folder / parts.FILE
        good = parts.unseal(parts.read(file), certificates.ed25519_of(authority.certificate), authority.fleet)
        assert good.image
        reference = next(name for name in good.image if "/base:" in name)
        async with FleetClient(state.endpoint) as client:
            gateway = await client.gateway()

            async def until_problem(text: str) -> None:
                async with asyncio.timeout(60):
                    while True:
                        now = client.plane.registry.gateways[gateway].parts_problem
                        if (text in now) if text else not now:
                            return
                        await asyncio.sleep(0.1)

            await until_problem("")
            assert client.plane.registry.gateways[gateway].parts == "parts 1"
            await client.image_fetch(gateway, reference)  # it is here, and signed

            others = dict.fromkeys(good.image, ("0" * 64,))
            authority.sign_parts(parts.Parts(image=others, skill=good.skill, model=good.model))
            with pytest.raises(IdentityError, match="is not signed"):
                await client.image_fetch(gateway, reference)
            await until_problem(reference)
            status = client.plane.registry.gateways[gateway]
            assert status.parts == "parts 2"
            assert status.refused["unsigned image"] == 1
            async with asyncio.timeout(60):
                while not any(each.id == f"parts.{gateway}" for each in (await client.alerts()).alerts):
                    await asyncio.sleep(0.2)

            authority.sign_parts(good)
            await client.image_fetch(gateway, reference)
            await until_problem("")
