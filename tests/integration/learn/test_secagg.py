"""Secure aggregation with real gateways and containers: the same models as without, and no update in the clear."""

import json
from pathlib import Path

import pytest
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.learn import privacy
from appliance.learn.datasets.make import Clips, make_clips
from appliance.model.learning import Clients, Data, Dp, Evaluation, Mode, Recipe, Rounds, RunState, Update
from appliance.pool.settings import PoolConfig
from appliance.skills._lib.learning import models, shards
from tests.integration.learn.test_faults import ended, fleet_of, write_model

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(600), pytest.mark.long]


def types_of_files(folder: Path, known: set[str]) -> set[str]:
    """The types of values in all safetensors files that gateways keep, but for those of known digests."""
    found: set[str] = set()
    for file in folder.glob("gw-*/**/artifacts/??/*"):
        data = file.read_bytes()
        if file.name in known or data.startswith(b"{"):
            continue  # a model, or the manifest of one
        found |= {entry.dtype for entry in shards.read_header(data, len(data)).values()}
    return found


async def test_masked_updates_make_the_models_of_plain_ones(tmp_path: Path) -> None:
    """Four robots at two gateways, then three, since one's data are damaged: the digests are those without masks.

    What gateways keep of the masked run are models and numbers of 64 bits.
    """
    pools: list[PoolConfig] = []
    clips = Clips(train_sites=2, test_sites=1, train_clips=1, test_clips=1)
    for number in (1, 2):
        folder = tmp_path / f"data-{number}"
        for robot in (number, number + 2):
            make_clips(folder / f"drone_{robot}" / "clips", replace(clips, seed=robot))
        write_model(folder, "sound")
        pools.append(PoolConfig(floor={"learn": 2}, capacity=3, folders={"learning": str(folder)}))
    masked = Recipe(
        model="sound", data=Data(folder="{robot}/clips"),
        clients=Clients(robots=tuple(f"drone_{number}" for number in range(1, 5))),
        rounds=Rounds(count=2), update=Update(secagg=True), evaluation=Evaluation(every=0),
    )  # fmt: skip
    plain = replace(masked, update=Update(), rounds=Rounds(count=2, mode=Mode.SYNC))
    async with fleet_of(tmp_path, pools, robots=4) as fleet, FleetClient(fleet.endpoint) as client:
        for robots in (4, 3):
            await client.learn_start(f"masked-{robots}", masked)
            secure = await ended(client, f"masked-{robots}")
            assert secure.state is RunState.SUCCEEDED
            if robots == 4:
                known = {str(each["artifact"]) for model in secure.models for each in model.shards}
                assert types_of_files(Path(fleet.directory), known) == {"I64"}
            await client.learn_start(f"plain-{robots}", plain)
            clear = await ended(client, f"plain-{robots}")
            assert [line.clients for line in secure.history] == [robots, robots], secure
            assert [line.digest for line in secure.history] == [line.digest for line in clear.history]
            assert {each.epsilon for each in secure.history} == {None}
            for file in (tmp_path / "data-2" / "drone_4" / "clips").rglob("*.avi"):
                file.write_bytes(b"damaged")
        base = models.initial(models.read("sound", [tmp_path / "data-1" / "models"]).tensors(10), masked.seed)
        for name, recipe in (("dp-masked", masked), ("dp-plain", plain)):
            private = replace(recipe.update, dp=Dp(clip=0.01, noise=1.0))
            await client.learn_start(name, replace(recipe, update=private, rounds=replace(recipe.rounds, count=1)))
            run = await ended(client, name)
            assert [(line.clients, line.epsilon) for line in run.history] == [(3, privacy.epsilon(1.0, 1, 1e-5))]
            manifest = shards.parse_manifest(json.loads(await client.artifact(run.model.manifest or {})))
            files = [await client.artifact(reference) for reference in run.model.shards]
            values = shards.join(manifest, files)
            # Each of three updates is cut to 0.01; noise of 0.01 in 650 values adds a third of 0.255 to their mean.
            change = shards.squared_norm(values[tensor] - base[tensor] for tensor in values) ** 0.5
            assert 0.05 < change < 0.12, (name, change)
