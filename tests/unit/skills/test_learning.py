"""Handlers of federated learning that need no network: the sum of updates, the last layer, sound, text."""

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from appliance.learn.datasets.flac import write_flac
from appliance.skills._lib.learning import coding, models, shards, sounds

Make = Callable[..., Any]
Load = Callable[..., ModuleType]


@pytest.fixture
def ctx_in(make_ctx: Make, tmp_path: Path) -> Callable[..., Any]:
    """Return a function that makes a ctx of a skill, with a folder of data and a cache."""

    def make(skill: str, **params: Any) -> Any:
        ctx = make_ctx(**params)
        ctx.folder = Path(models.FOLDER).parent / skill
        ctx.cache = tmp_path / "cache"
        ctx.preloaded = None

        def host_folder(name: str) -> Path:
            return tmp_path / name

        ctx.host_folder = host_folder
        ctx.alive = lambda: None
        (tmp_path / "learning").mkdir(exist_ok=True)
        return ctx

    return make


def _update(ctx: Any, client: str, seed: int, *, weight: int = 1024) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    values = {
        each.name: (rng.normal(size=each.shape) * 0.01).astype(np.float32) for each in models.read("clips").tensors(10)
    }
    files = list(shards.split(values))
    references = [ctx.put_artifact(f"{client}-{number}", data) for number, (_, data) in enumerate(files)]
    return {"client": client, "manifest": shards.collect(files).to_json(), "shards": references, "weight": weight}


def _model(ctx: Any, result: dict[str, Any]) -> dict[str, Any]:
    manifest = shards.parse_manifest(result["manifest"])
    return shards.join(manifest, [ctx.files[each["artifact"]] for each in result["shards"]])


def test_updates_become_a_model(ctx_in: Make, handler: Load) -> None:
    """The first round begins with drawn values, the next with the model of the first; the manifest may be a file."""
    ctx = ctx_in("aggregate", model="clips", seed=5)
    ctx.params["updates"] = [_update(ctx, "a", 1, weight=3072), _update(ctx, "b", 2)]
    run = handler("aggregate").run
    first = run(ctx)
    begun = models.initial(models.read("clips").tensors(10), 5)
    one, two = (_model(ctx, each) for each in ctx.params["updates"])
    for name, values in _model(ctx, first).items():
        assert np.allclose(values, begun[name] + 0.75 * one[name] + 0.25 * two[name], atol=1e-6)
    assert first["verdicts"]["a"]["accepted"]
    assert first["model"] == {"manifest": first["manifest"], "shards": first["shards"]}
    assert first["weight"] == 4096
    file = ctx.put_artifact("manifest.json", json.dumps(first["manifest"]).encode(), "application/json")
    ctx.params["base"] = {"manifest": file, "shards": first["shards"]}
    second = _model(ctx, run(ctx))
    assert np.allclose(second["head.bias"], 2 * _model(ctx, first)["head.bias"] - begun["head.bias"], atol=1e-6)


def test_bad_updates_are_told_and_do_not_count(ctx_in: Make, handler: Load) -> None:
    """A manifest that is none, too few shards, and a size that is announced otherwise are verdicts, not failures."""
    ctx = ctx_in("aggregate", model="clips")
    good = _update(ctx, "a", 1)
    none = {**_update(ctx, "none", 2), "manifest": {"format": 7}}
    few: dict[str, Any] = {**_update(ctx, "few", 3), "shards": []}
    large = _update(ctx, "large", 4)
    large["shards"] = [{**each, "bytes": 10**12} for each in large["shards"]]
    ctx.params["updates"] = [good, none, few, large]
    result = handler("aggregate").run(ctx)
    reasons = {client: each["reason"] for client, each in result["verdicts"].items()}
    assert reasons == {"a": "", "none": "manifest", "few": "manifest", "large": "size"}
    clean = ctx_in("aggregate", model="clips", updates=[good])
    clean.files = ctx.files
    assert handler("aggregate").run(clean)["shards"] == result["shards"]


def test_updates_in_8_bits_are_summed_as_what_they_stand_for(ctx_in: Make, handler: Load) -> None:
    """Beside one that is sent as it is; the files have less than a third of the bytes of random values."""
    ctx = ctx_in("aggregate", model="clips")
    plain = [_update(ctx, client, number) for number, client in enumerate("ab", start=1)]
    values = _model(ctx, plain[1])
    work = handler("aggregate").work
    coded = work.keep_coded(ctx, values, {}, "update-1", scale=1.0)
    assert sum(each["bytes"] for each in coded.shards) < 0.33 * sum(each["bytes"] for each in plain[1]["shards"])
    update = {**plain[1], "manifest": coded.manifest, "shards": coded.shards, "coding": "int8"}
    run = handler("aggregate").run
    ctx.params["updates"] = plain
    exact = _model(ctx, run(ctx))
    ctx.params["updates"] = [plain[0], update]
    result = run(ctx)
    assert all(each["accepted"] for each in result["verdicts"].values())
    for name, each in _model(ctx, result).items():
        assert np.abs(each - exact[name]).max() <= 0.51 * np.abs(values[name]).max() / 127


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"bytes": 10**9}, "size"),
        ({"bytes": 0}, "size"),
        ({"bytes": "many"}, "size"),
        ({"bytes": None}, "size"),
    ],
)
def test_an_update_in_8_bits_of_another_size_is_refused_before_it_is_fetched(
    ctx_in: Make, handler: Load, changes: dict[str, Any], reason: str
) -> None:
    """A reference that announces more than packing can make of the file, or nothing."""
    ctx = ctx_in("aggregate", model="clips", report=True)
    plain = _update(ctx, "a", 1)
    coded = handler("aggregate").work.keep_coded(ctx, _model(ctx, plain), {}, "u", scale=1.0)
    references = [{**each, **changes} for each in coded.shards]
    ctx.params["updates"] = [{**plain, "manifest": coded.manifest, "shards": references, "coding": "int8"}]
    assert handler("aggregate").run(ctx)["verdicts"]["a"]["reason"] == reason


def test_a_zip_bomb_is_not_unpacked_and_foreign_bytes_are_refused(ctx_in: Make, handler: Load) -> None:
    """More than the manifest announced, a plain file said to be packed, a packed one said to be plain."""
    ctx = ctx_in("aggregate", model="clips", report=True)
    plain = _update(ctx, "a", 1)
    coded = handler("aggregate").work.keep_coded(ctx, _model(ctx, plain), {}, "u", scale=1.0)
    bomb = ctx.put_artifact("bomb", zlib.compress(bytes(50 << 20), 9))
    good = {"client": "c", "weight": 1024, "manifest": coded.manifest, "shards": coded.shards}
    ctx.params["updates"] = [
        {**good, "client": "bomb", "shards": [bomb], "coding": "int8"},
        {**plain, "client": "plain", "coding": "int8"},
        {**good, "client": "packed"},
    ]
    verdicts = handler("aggregate").run(ctx)["verdicts"]
    assert verdicts["bomb"]["reason"] in ("size", "format")
    assert verdicts["plain"]["reason"] in ("missing", "dtype", "extra")
    assert verdicts["packed"]["reason"] in ("dtype", "extra", "missing")


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_what_8_bits_leave_over_is_in_the_next_update(ctx_in: Make, handler: Load, scale: float) -> None:
    """Three updates as they are summed, and what is left over after them, are the three deltas, to the last bits.

    Lost files of what was left over are told and do without.
    """
    ctx = ctx_in("aggregate", model="clips")
    work = handler("aggregate").work
    tensors = models.read("clips").tensors(10)
    pieces = shards.layout(shards.Spec(each.name, "F32", each.shape) for each in tensors)
    total: dict[str, Any] = {}
    summed: dict[str, Any] = {}
    parts: list[list[dict[str, Any]]] = []
    for number in range(3):
        delta = _model(ctx, _update(ctx, "a", number))
        coded = work.keep_coded(ctx, delta, work.residual(ctx, parts, tensors), f"u{number}", scale=scale)
        manifest = shards.parse_manifest(coded.manifest)
        file = work.fetch_coded(ctx, manifest, coded.shards, 0)
        decoded = coding.decode_shard(shards.decode(file, manifest, 0), pieces)
        for key in delta:
            total[key] = total.get(key, 0) + scale * delta[key].astype(np.float64)
            summed[key] = summed.get(key, 0) + scale * decoded[key].astype(np.float64)
        parts = [coded.residual]
    left = work.residual(ctx, parts, tensors)
    twice = work.residual(ctx, [parts[0], parts[0]], tensors)
    for key, wanted in total.items():
        assert np.allclose(summed[key] + left[key], wanted, atol=1e-6)
        assert np.allclose(twice[key], 2 * left[key])
    assert work.residual(ctx, [[]], tensors) == {}
    assert any("left over of the last update is not added" in text for text in ctx.logged)


def test_an_update_that_no_gateway_has_is_told_and_does_not_count(ctx_in: Make, handler: Load) -> None:
    """The gateway that made it is gone: the others make the model. With none left a report says so, else it fails."""
    ctx = ctx_in("aggregate", model="clips")
    kept, gone = _update(ctx, "a", 1), _update(ctx, "gone", 2)
    get = ctx.get_artifact

    def fetch(reference: dict[str, Any]) -> bytes:
        if reference == gone["shards"][0]:
            raise ctx.CallError("not-found", "artifact 1234 is on no gateway that answers")
        return get(reference)

    ctx.get_artifact = fetch
    ctx.params["updates"] = [kept, gone]
    run = handler("aggregate").run
    verdicts = run(ctx)["verdicts"]
    assert (verdicts["a"]["accepted"], verdicts["gone"]["reason"]) == (True, "lost")
    ctx.params |= {"updates": [gone], "report": True}
    few = run(ctx)
    assert (few["needed"], few["verdicts"]["gone"]["reason"], "manifest" in few) == (1, "lost", False)
    ctx.params["report"] = False
    with pytest.raises(ctx.CallError, match="is on no gateway"):
        run(ctx)


def test_parts_of_one_share_count_once(ctx_in: Make, handler: Load) -> None:
    """Two updates of one client are added up and weigh as one; the same file given again changes nothing."""
    ctx = ctx_in("aggregate", model="clips")
    parts = [_update(ctx, "a", 1), _update(ctx, "a", 2)]
    ctx.params["updates"] = [*parts, parts[0]]
    result = handler("aggregate").run(ctx)
    begun = models.initial(models.read("clips").tensors(10), 0)
    one, two = (_model(ctx, each) for each in parts)
    assert result["weight"] == 1024
    assert np.allclose(
        _model(ctx, result)["head.bias"], begun["head.bias"] + one["head.bias"] + two["head.bias"], atol=1e-6
    )


def test_an_aggregation_that_cannot_be(ctx_in: Make, handler: Load) -> None:
    """No fit update, a base of another model, an unknown model, a parameter that cannot be: each is reported."""
    run = handler("aggregate").run
    ctx = ctx_in("aggregate", model="clips")
    ctx.params["updates"] = [{**_update(ctx, "none", 2), "manifest": {}}]
    with pytest.raises(ctx.CallError, match="none: manifest") as caught:
        run(ctx)
    assert caught.value.code == "precondition"
    ctx.params["updates"] = [_update(ctx, "a", 1)]
    words = models.initial(models.read("words").tensors(12), 1)
    files = list(shards.split(words))
    ctx.params["base"] = {
        "manifest": shards.collect(files).to_json(),
        "shards": [ctx.put_artifact("w", data) for _, data in files],
    }
    with pytest.raises(ctx.Fail, match="the model that this round begins with is refused"):
        run(ctx)
    ctx.params |= {"model": "songs", "base": None}
    with pytest.raises(ctx.Fail, match="no model 'songs'"):
        run(ctx)
    ctx.params |= {"model": "clips", "updates": []}
    with pytest.raises(ctx.CallError, match="updates is 0") as caught:
        run(ctx)
    assert caught.value.code == "payload"


def test_a_base_that_no_gateway_has_is_waited_for(ctx_in: Make, handler: Load) -> None:
    """All that kept the model are gone: the run fails for what passes, by which the round waits and says why."""
    ctx = ctx_in("aggregate", model="clips", report=True)
    ctx.params["updates"] = [_update(ctx, "a", 1)]
    gone = {"artifact": "0" * 64, "bytes": 7}
    ctx.params["base"] = {"manifest": gone, "shards": [gone]}
    get = ctx.get_artifact

    def fetch(reference: dict[str, Any]) -> bytes:
        if reference == gone:
            raise ctx.CallError("not-found", "artifact 0000 is on no gateway that answers")
        return get(reference)

    ctx.get_artifact = fetch
    with pytest.raises(ctx.CallError, match="the model that this round begins with cannot be fetched") as caught:
        handler("aggregate").run(ctx)
    assert (caught.value.code, caught.value.retryable) == ("not-found", True)


def test_in_a_plan_the_updates_are_what_was_handed_on(ctx_in: Make, handler: Load) -> None:
    """After `train_local` subtasks only the model is named: weights are samples, partial work is scaled."""
    ctx = ctx_in("aggregate", model="clips")
    for name, steps in (("s1", 6), ("s2", 3)):
        update = _update(ctx, name, 1)
        ctx.inputs[name] = {
            "skill": "train_local", "update": {"manifest": update["manifest"], "shards": update["shards"]},
            "samples": 96, "steps": steps, "steps_of_epoch": 6,
        }  # fmt: skip
    result = handler("aggregate").run(ctx)
    assert result["weight"] == 2 * 96 * 1024
    assert result["norms"]["s2"] == pytest.approx(2 * result["norms"]["s1"])


def _export(folder: Path, name: str, classes: int, *, names: str = "") -> dict[str, Any]:
    """Lay a trained model where a gateway has it."""
    values = models.initial(models.read(name).tensors(classes), 3)
    files = list(shards.split(values))
    target = folder / "learning" / "models" / name
    target.mkdir(parents=True)
    (target / "manifest.json").write_text(json.dumps(shards.collect(files).to_json()))
    for number, (_, data) in enumerate(files):
        (target / f"model-{number:05d}.safetensors").write_bytes(data)
    if names:
        (target / "classes.txt").write_text(names)
    return values


def test_features_become_an_action(ctx_in: Make, handler: Load, tmp_path: Path) -> None:
    """The last layer of the gateway's trained model scores the features; classes are those it was trained with."""
    values = _export(tmp_path, "clips", 3, names="Walk\nRun\nFall\n")
    ctx = ctx_in("classify_action")
    features = (values["head.weight"][2] * 5).tolist()
    ctx.inputs["s1"] = {"skill": "encode_clip", "features": features, "model": "clips"}
    result = handler("classify_action").run(ctx)
    assert result["label"] == "Fall"
    assert result["likely"][0]["label"] == "Fall"
    assert sum(each["confidence"] for each in result["likely"]) == pytest.approx(1.0, abs=1e-3)


def test_a_model_that_is_not_there(ctx_in: Make, handler: Load, tmp_path: Path) -> None:
    """Without a trained model the run says how to get one; a damaged one is refused, features of another size too."""
    ctx = ctx_in("classify_action")
    run = handler("classify_action").run
    with pytest.raises(ctx.CallError, match="no features"):
        run(ctx)
    ctx.inputs["s1"] = {"skill": "encode_clip", "features": [1.0] * 64, "model": "clips"}
    with pytest.raises(ctx.Fail, match="there is no trained model clips") as caught:
        run(ctx)
    assert "swiftbot learn start clips" in caught.value.remedy
    _export(tmp_path, "clips", 10)
    for wrong in ([1.0] * 3, [float("nan")] * 64, ["x"] * 64, [[1.0]] * 64):
        ctx.inputs["s1"]["features"] = wrong
        with pytest.raises(ctx.CallError, match="64 finite numbers"):
            run(ctx)
    file = tmp_path / "learning" / "models" / "clips" / "model-00000.safetensors"
    file.write_bytes(file.read_bytes()[:-4])
    ctx.inputs["s1"]["features"] = [1.0] * 64
    with pytest.raises(ctx.Fail, match="the trained model clips cannot be used"):
        run(ctx)


def test_a_transcript_is_corrected(ctx_in: Make, handler: Load) -> None:
    """The last text handed on is put right, and each change is reported."""
    ctx = ctx_in("correct_text")
    module = handler("correct_text")
    with pytest.raises(ctx.CallError, match="no text was handed on"):
        module.run(ctx)
    ctx.preloaded = module.preload(ctx)
    ctx.inputs["s1"] = {"skill": "transcribe", "text": "rovr one  go to doc two", "recogniser": "sentences"}
    assert module.run(ctx) == {
        "text": "ROVER ONE GO TO DOCK TWO",
        "before": "ROVR ONE GO TO DOC TWO",
        "changes": [{"heard": "ROVR", "meant": "ROVER"}, {"heard": "DOC", "meant": "DOCK"}],
    }


@pytest.fixture
def recording() -> np.ndarray[Any, np.dtype[np.float32]]:
    """Two words with a pause between them, and noise."""
    wave = np.random.default_rng(3).normal(0, 0.004, 48_000).astype(np.float32)
    for start in (4_000, 30_000):
        wave[start : start + 9_000] += np.sin(np.arange(9_000) * 0.2).astype(np.float32) * 0.4
    return wave


@pytest.fixture
def sound(monkeypatch: pytest.MonkeyPatch, handler: Load, recording: Any) -> Load:
    """Return a function that loads a handler with stand-ins for ffmpeg and soundfile, which the image has."""

    def load(skill: str) -> ModuleType:
        module: Any = handler(skill)
        recordings: Any = module.recordings

        def wave(*_: object) -> Any:
            return recording

        def keep(ctx: Any, samples: Any, name: str) -> Any:
            data = write_flac((samples * 32767).astype(np.int16), rate=sounds.RATE)
            return ctx.put_artifact(name, data, "audio/flac")

        monkeypatch.setattr(recordings, "wave", wave)
        monkeypatch.setattr(recordings, "keep", keep)
        return module

    return load


def test_a_recording_is_cut_at_pauses(ctx_in: Make, sound: Load) -> None:
    """Two words are two segments of 16 kHz with their times."""
    ctx = ctx_in("preprocess_audio")
    ctx.inputs["s1"] = {"audio": ctx.put_artifact("yard.wav", b"RIFF", "audio/wav")}
    result = sound("preprocess_audio").run(ctx)
    assert [each["name"] for each in result["audio"]] == ["yard-001.flac", "yard-002.flac"]
    assert [round(each["start_s"], 1) for each in result["segments"]] == [0.2, 1.8]
    assert result["duration_s"] == 3.0
    assert "note" not in result


def test_recordings_are_found(ctx_in: Make, sound: Load, tmp_path: Path) -> None:
    """By name among what was handed on, else in the gateway's folder; no name leads out of it."""
    module = sound("preprocess_audio")
    with pytest.raises(Exception, match="no recording was handed on"):
        module.run(ctx_in("preprocess_audio"))
    (tmp_path / "learning" / "audio").mkdir(parents=True)
    (tmp_path / "learning" / "audio" / "a.wav").write_bytes(b"RIFF")
    assert module.run(ctx_in("preprocess_audio", source="a.wav"))["source"] == "a.wav"
    for wrong in ("b.wav", "../audio/a.wav", "/etc/passwd"):
        ctx = ctx_in("preprocess_audio", source=wrong)
        with pytest.raises(ctx.CallError, match="no recording was handed on"):
            module.run(ctx)
    ctx = ctx_in("preprocess_audio", source="b.wav")
    ctx.inputs["s1"] = {"audio": ctx.put_artifact("yard.wav", b"RIFF", "audio/wav")}
    with pytest.raises(ctx.CallError, match=r"no recording 'b\.wav' among what was handed on \(yard\.wav\)"):
        module.run(ctx)
