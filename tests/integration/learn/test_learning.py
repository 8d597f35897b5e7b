"""Federated training in real containers of image `learn`: clients train, updates are summed, the model is judged, used.

The image is built where it is missing, which takes minutes.
"""

import asyncio
import hashlib
import json
import wave
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pool_bench import Bench

from appliance.errors import PayloadError
from appliance.learn.datasets import clips as drawn
from appliance.learn.datasets.avi import write_avi
from appliance.learn.datasets.make import Clips, Speech, make_clips, make_speech
from appliance.learn.datasets.speech import Speaker
from appliance.learn.export import TOLERANCE, check_onnx
from appliance.model import ContainerState, Need, RunEvent, RunEventKind, RunRequest, Site
from appliance.pool import images
from appliance.pool.pool import Call, Pool
from appliance.pool.selection import Candidate
from appliance.pool.settings import PoolConfig
from appliance.skills._lib.learning import models, shards
from appliance.skills.catalogue import load_catalogue

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(1500), pytest.mark.long]

CLIPS = Clips(train_sites=4, test_sites=2, train_clips=5, test_clips=5)


class Learning:
    """A pool whose containers train, with the files of its handlers kept in memory."""

    def __init__(self, pool: Pool, folder: Path, files: dict[str, bytes]) -> None:
        self.pool = pool
        self.folder = folder
        self.files = files
        self.events: list[RunEvent] = []
        self.runs = 0

    def put(self, name: str, data: bytes, media_type: str) -> dict[str, Any]:
        """Keep a file."""
        digest = hashlib.sha256(data).hexdigest()
        self.files[digest] = data
        return {"artifact": digest, "name": name, "media_type": media_type, "bytes": len(data), "gateway": "g1"}

    async def last(self, skill: str, *, inputs: dict[str, Any] | None = None, **more: Any) -> RunEvent:
        """Run a skill; returns its last event."""
        self.runs += 1
        manifest = load_catalogue().skills[skill]
        resume = more.pop("resume", None)
        need = Need(image=manifest.image, cpu=manifest.cpu, memory_mb=manifest.memory_mb)
        request = RunRequest(
            task=f"t{self.runs}", subtask="s1", attempt=1, skill=skill, need=need, params=more, inputs=inputs or {},
            deadline_s=600.0, resume=resume, calls=100 if resume else 0,
            robot="r1" if manifest.runs == "robot" else None,
        )  # fmt: skip
        decision = await self.pool.select(need, allow_remote=False)
        self.events = []
        return await self.pool.run(request, decision, self.events.append)

    async def run(self, skill: str, *, inputs: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
        """Run a skill; returns its result."""
        event = await self.last(skill, inputs=inputs, **more)
        assert event.kind is RunEventKind.SUCCEEDED, event.failure
        assert event.result is not None
        return {"skill": skill, **event.result}

    async def round(self, number: int, base: dict[str, Any] | None, *, of: int = 2) -> dict[str, Any]:
        """Have each client train, and sum their updates; returns what `aggregate` returns."""
        updates: list[dict[str, Any]] = []
        for client in range(of):
            trained = await self.run(
                "train_local", run="r", round=number, client=f"c{client}", model="clips", base=base, seed=3, epochs=3,
                part={"by": "even", "index": client, "of": of},
            )  # fmt: skip
            update = {key: trained[key] for key in ("manifest", "shards")}
            updates.append({"client": f"c{client}", "weight": trained["samples"] * 1024, **update})
        return await self.run("aggregate", run="r", round=number, model="clips", base=base, updates=updates, seed=3)

    def export(self, model: dict[str, Any], name: str) -> None:
        """Lay a model where the gateway's containers find it for use."""
        target = self.folder / "models" / name
        target.mkdir(parents=True, exist_ok=True)
        (target / "manifest.json").write_text(json.dumps(model["manifest"]))
        for number, reference in enumerate(model["shards"]):
            (target / f"model-{number:05d}.safetensors").write_bytes(self.files[reference["artifact"]])


def _base(result: dict[str, Any]) -> dict[str, Any]:
    return {"manifest": result["manifest"], "shards": result["shards"]}


@pytest.fixture
async def learning(bench: Bench) -> Learning:
    """Return a pool with one container of image `learn` that has loaded everything."""
    catalogue = load_catalogue()
    await images.build("learn", catalogue)
    folder = bench.folder / "learning"
    make_clips(folder / "clips", CLIPS)
    files: dict[str, bytes] = {}

    async def nobody(need: Need, avoid: Collection[str]) -> list[Candidate]:
        return []

    async def answer(call: Call) -> dict[str, Any]:
        if call.name == "put_artifact":
            return it.put(call.args["name"], call.args["data"], call.args["media_type"])
        assert call.name == "get_artifact"
        return {"data": files[call.args["ref"]["artifact"]]}

    pool = Pool(
        PoolConfig(floor={"learn": 1}, capacity=2, mode="local", folders={"learning": str(folder)}),
        gateway="g1", fleet=bench.fleet, run_dir=bench.folder / "run", data_dir=bench.folder / "data",
        catalogue=catalogue, site=Site(), find_remote=nobody, on_call=answer, on_change=lambda _: None,
    )  # fmt: skip
    bench.pools.append(pool)
    it = Learning(pool, folder, files)
    await pool.start()
    async with asyncio.timeout(300):
        while not any(each.state is ContainerState.READY for each in pool.containers()):
            assert not pool.problem, pool.problem
            await asyncio.sleep(0.1)
    return it


async def test_clients_train_a_model(learning: Learning) -> None:
    """Two clients train clips for some rounds: loss falls, the model is better than chance on sites that nobody has."""
    warm = [each for each in learning.pool.containers() if each.image == "learn"]
    assert warm[0].compatible == ("base", "vision")
    base: dict[str, Any] | None = None
    losses: list[float] = []
    judged: dict[str, Any] = {}
    for number in range(6):
        result = await learning.round(number, base)
        base = _base(result)
        assert all(each["accepted"] for each in result["verdicts"].values())
        judged = await learning.run("evaluate", model="clips", base=base)
        losses.append(judged["loss"])
    assert judged["items"] == 100
    assert losses[-1] < 0.9 * losses[0], losses
    assert judged["accuracy"] > 0.2, judged


@pytest.mark.parametrize("name", ["clips", "words", "sentences"])
async def test_an_exported_onnx_file_computes_what_the_model_does(learning: Learning, name: str) -> None:
    """Made in a container of a model for 7 or its own classes; onnxruntime here makes of samples what PyTorch made."""
    model = models.read(name)
    values = models.initial(model.tensors(len(model.classes) or 7), 5)
    files = list(shards.split(values))
    base = {
        "manifest": shards.collect(files, norm=1.0).to_json(),
        "shards": [learning.put(f"{name}.safetensors", data, "application/x-safetensors") for _, data in files],
    }
    made = await learning.run("evaluate", model=name, base=base, export="onnx")
    data = learning.files[made["file"]["artifact"]]
    assert check_onnx(data, learning.files[made["checks"]["artifact"]]) < TOLERANCE
    other = models.initial(model.tensors(len(model.classes) or 7), 6)
    files = list(shards.split(other))
    base["shards"] = [learning.put(f"{name}.safetensors", data, "application/x-safetensors") for _, data in files]
    base["manifest"] = shards.collect(files, norm=1.0).to_json()
    checks = (await learning.run("evaluate", model=name, base=base, export="onnx"))["checks"]
    with pytest.raises(PayloadError, match="differs from the model"):
        check_onnx(data, learning.files[checks["artifact"]])
    lost = await learning.last("evaluate", model=name, export="onnx")
    assert lost.failure is not None
    assert "no trained model to export" in lost.failure.message


async def test_the_same_arguments_give_the_same_update(learning: Learning) -> None:
    """Training again, going on from a checkpoint, and another order of updates come to the same digests."""
    order: dict[str, Any] = {
        "run": "r", "round": 1, "client": "c1", "model": "clips", "seed": 7, "epochs": 2, "every_steps": 5,
        "part": {"by": "dirichlet:0.5", "index": 1, "of": 3},
    }  # fmt: skip
    first = await learning.run("train_local", **order)
    kept = [event.result for event in learning.events if event.kind is RunEventKind.CHECKPOINT]
    assert kept
    again = await learning.run("train_local", **order)
    assert again["shards"][0]["artifact"] == first["shards"][0]["artifact"]
    resumed = await learning.run("train_local", **order, resume=kept[0])
    assert resumed["shards"][0]["artifact"] == first["shards"][0]["artifact"]
    assert resumed["steps"] == first["steps"]
    assert resumed["loss"] == pytest.approx(first["loss"])
    order["seed"] = 8
    other = await learning.run("train_local", **order)
    assert other["shards"][0]["artifact"] != first["shards"][0]["artifact"]


async def test_updates_in_8_bits(learning: Learning) -> None:
    """Four rounds in 8 bits: a fifth of the bytes at most, the same again each time, and what they learn is the same.

    What rounding lost goes into the client's next update: without it that is another one.
    """
    losses: dict[str, float] = {}
    sent: dict[str, int] = {}
    for coding in ("none", "int8"):
        base: dict[str, Any] | None = None
        left: dict[int, Any] = {}
        for number in range(4):
            updates: list[dict[str, Any]] = []
            for client in range(2):
                order: dict[str, Any] = {
                    "run": "r", "round": number, "client": f"c{client}", "model": "clips", "base": base, "seed": 3,
                    "epochs": 3, "part": {"by": "even", "index": client, "of": 2}, "compression": coding,
                }  # fmt: skip
                trained = await learning.run("train_local", **order, residual=left.get(client, []))
                if coding == "int8":
                    assert trained["coding"] == "int8"
                    if number == 1 and client == 0:
                        again = await learning.run("train_local", **order, residual=left[client])
                        assert again["shards"] == trained["shards"]
                        without = await learning.run("train_local", **order)
                        assert without["shards"] != trained["shards"]
                    left[client] = [trained["residual"]]
                sent[coding] = sum(each["bytes"] for each in trained["shards"])
                update = {key: trained[key] for key in ("manifest", "shards", "coding") if key in trained}
                updates.append({"client": f"c{client}", "weight": trained["samples"] * 1024, **update})
            result = await learning.run(
                "aggregate", run="r", round=number, model="clips", base=base, updates=updates, seed=3
            )
            assert all(each["accepted"] for each in result["verdicts"].values())
            base = _base(result)
        losses[coding] = (await learning.run("evaluate", model="clips", base=base))["loss"]
    print(sent, losses)
    assert sent["int8"] <= 0.2 * sent["none"], sent
    assert losses["int8"] == pytest.approx(losses["none"], rel=0.03), losses


async def test_partial_work_of_a_slow_device(learning: Learning) -> None:
    """A client that is slow stops in time with the steps it has made; each batch lasts as on the device."""
    result = await learning.run(
        "train_local", model="clips", seed=1, epochs=50, speed=4.0, nominal_batch_s=0.05, stop_at_s=3.0
    )
    assert 1 <= result["steps"] < result["steps_of_epoch"] * 50
    assert result["train_s"] >= 0.2 * (result["steps"] - 1)
    assert any("samples/s" in event.note for event in learning.events)


async def test_words_and_sentences_train(learning: Learning) -> None:
    """The other two models make a step on recordings, which soundfile decodes as they were written."""

    def hum(who: Speaker, text: str) -> np.ndarray[Any, np.dtype[np.float32]]:
        times = np.arange(1600, dtype=np.float32) / 16_000
        return np.concatenate([np.sin(times * (100 + who.pitch + 10 * ord(letter))) for letter in text])

    for kind in ("words", "sentences"):
        settings = Speech(kind=kind, train_speakers=2, test_speakers=1, recordings=12)
        make_speech(learning.folder / kind, settings, synthesise=hum)
        result = await learning.run("train_local", model=kind, epochs=2, part={"by": "speaker", "index": 0, "of": 2})
        assert result["samples"] == 12
        assert result["damaged"] == 0
        base = _base(await learning.run("aggregate", model=kind, inputs={"s1": result}))
        judged = await learning.run("evaluate", model=kind, base=base)
        assert judged["items"] == 12
        assert 0.0 <= judged["accuracy"] <= 1.0


async def test_damage_that_only_decoding_shows(learning: Learning) -> None:
    """Clips whose pictures are broken are counted; with more than 5 % of them the client refuses and lists them."""
    listed = sorted((learning.folder / "clips" / "UCF-101" / "Walk").glob("*_g0[3-6]_*.avi"))
    picture = b"\xff\xd8 no picture"
    for file in listed[:2]:
        file.write_bytes(write_avi([picture] * drawn.FRAMES, width=80, height=60, fps=8))
    result = await learning.run("train_local", model="clips")
    assert (result["samples"], result["damaged"]) == (198, 2)
    for file in sorted((learning.folder / "clips" / "UCF-101" / "Run").glob("*_g0[3-6]_*.avi"))[:12]:
        file.write_bytes(write_avi([picture] * drawn.FRAMES, width=80, height=60, fps=8))
    event = await learning.last("train_local", model="clips")
    assert event.failure is not None
    assert "14 of 200 files are damaged, more than 5%" in event.failure.message
    assert "v_Run_g03_c01.avi" in event.failure.message


async def test_orders_that_cannot_be(learning: Learning) -> None:
    """A missing data set, a parameter that cannot be and a base of another model end a run with the reason."""
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"model": "clips", "data": {"name": "nothing"}}, "has neither"),
        ({"model": "clips", "data": {"folder": "/etc"}}, "data is '/etc'"),
        ({"model": "songs"}, "no model 'songs'"),
        ({"model": "clips", "part": {"by": "site", "index": 0, "of": 9}}, "4 groups for 9 clients"),
        ({"model": "clips", "base": {"manifest": {}, "shards": []}}, "refused (manifest)"),
    ]
    for params, told in wrong:
        event = await learning.last("train_local", **params)
        assert event.failure is not None, params
        assert told in event.failure.message, event.failure


async def test_a_trained_model_is_used(learning: Learning) -> None:
    """A video is cut into frames, encoded and classified as `evaluate` would; without a model the run says so."""
    pictures = drawn.clip(drawn.site(5, 40), "DriveStraight", 5, 40, 1)
    video = write_avi(pictures, width=drawn.WIDTH, height=drawn.HEIGHT, fps=drawn.FPS)
    recorded = {"skill": "record_video", "video": learning.put("aisle.avi", video, "video/x-msvideo")}
    frames = await learning.run("extract_frames", inputs={"s1": recorded}, fps=8)
    assert frames["count"] >= 15
    event = await learning.last("encode_clip", inputs={"s2": frames})
    assert event.failure is not None
    assert "there is no trained model clips" in event.failure.message
    values = models.initial(models.read("clips").tensors(10), 3)
    files = list(shards.split(values))
    references = [learning.put("m", data, "application/x-safetensors") for _, data in files]
    learning.export({"manifest": shards.collect(files).to_json(), "shards": references}, "clips")
    features = await learning.run("encode_clip", inputs={"s2": frames})
    assert len(features["features"]) == 64
    assert features["count"] == frames["count"]
    still = await learning.run("encode_clip", inputs={"s2": frames | {"frames": frames["frames"][:1] * 9}})
    assert still["count"] == 9
    assert "note" not in still
    action = await learning.run("classify_action", inputs={"s3": features})
    assert action["label"] in drawn.CLASSES
    assert 0.0 < action["confidence"] <= 1.0


async def test_speech_becomes_text(learning: Learning) -> None:
    """Without a trained model pocketsphinx listens, with one the network; both run from sound to corrected text."""
    times = np.arange(24_000) / 16_000
    tone = np.where((times > 0.3) & (times < 1.0), np.sin(times * 900 + np.sin(times * 40)), 0.0)
    noisy = tone * 0.5 + np.random.default_rng(1).normal(0, 0.003, len(times))
    file = learning.folder / "audio" / "call.wav"
    file.parent.mkdir()
    with wave.open(str(file), "wb") as out:
        out.setnchannels(2)
        out.setsampwidth(2)
        out.setframerate(16_000)
        out.writeframes(np.repeat((noisy * 32767).astype("<i2"), 2).tobytes())
    cleaned = await learning.run("preprocess_audio", source="call.wav")
    assert cleaned["duration_s"] == 1.5
    assert len(cleaned["audio"]) == 1
    heard = await learning.run("transcribe", inputs={"s1": cleaned})
    assert heard["recogniser"] == "pocketsphinx"
    model = models.read("sentences")
    files = list(shards.split(models.initial(model.tensors(len(model.classes)), 3)))
    references = [learning.put("m", data, "application/x-safetensors") for _, data in files]
    learning.export({"manifest": shards.collect(files).to_json(), "shards": references}, "sentences")
    heard = await learning.run("transcribe", inputs={"s1": cleaned})
    assert heard["recogniser"] == "sentences"
    meant = await learning.run("correct_text", inputs={"s2": heard | {"text": "ROVR ONE GO TO DOC TWO"}})
    assert meant["text"] == "ROVER ONE GO TO DOCK TWO"


MODEL = """
import torch

def build(classes):
    return torch.nn.Sequential(torch.nn.AdaptiveAvgPool3d((4, 4, 4)), torch.nn.Flatten(), torch.nn.Linear(64, classes),
                               torch.nn.BatchNorm1d(classes))
"""
TENSORS = """
name = "mine"
task = "classify"
input = "clip"
batch = 20
[[tensors]]
name = "2.weight"
shape = ["classes", 64]
[[tensors]]
name = "2.bias"
shape = ["classes"]
[[tensors]]
name = "3.weight"
shape = ["classes"]
[[tensors]]
name = "3.bias"
shape = ["classes"]
"""


async def test_a_model_of_ones_own(learning: Learning) -> None:
    """A model in the gateway's folder is trained; running statistics stay, a wrong list of tensors is refused."""
    folder = learning.folder / "models" / "mine"
    folder.mkdir(parents=True)
    (folder / "model.py").write_text(MODEL)
    (folder / "model.toml").write_text(TENSORS)
    result = await learning.run("train_local", model="mine", data={"name": "clips"})
    assert result["steps"] == 10
    assert "running statistics stay with each client: 3.running_mean" in result["note"]
    assert {each["name"] for each in result["manifest"]["tensors"]} == {"2.weight", "2.bias", "3.weight", "3.bias"}
    (folder / "model.toml").write_text(TENSORS.replace("64", "65"))
    event = await learning.last("train_local", model="mine", data={"name": "clips"})
    assert event.failure is not None
    assert "does not list the tensors of model.py: 2.weight" in event.failure.message
