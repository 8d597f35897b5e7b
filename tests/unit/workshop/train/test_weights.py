"""Weights are read back out of a model folder as they went into it, or it is said what the folder is instead."""

import json
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from appliance.errors import NotFoundError, PayloadError
from appliance.llm.settings import EMBEDDED_FOLDER
from workshop.train.weights import read_weights, unpacked


def test_the_embedded_planner_gives_its_weights_back() -> None:
    """All weights of its shape are there under their names, with the keys and values where the library keeps them.

    Queries and keys are turned by position and values are not: the rows of the one matrix are compared in their order.
    """
    shape, weights = read_weights(EMBEDDED_FOLDER)
    inside = {name for name in weights if name.startswith("model.layers.0.")}
    assert len(weights) == len(inside) * shape.layers + 3
    assert weights["model.layers.0.self_attn.k_proj.weight"].shape == (
        shape.width * shape.key_heads // shape.heads,
        shape.width,
    )
    assert weights["model.layers.0.mlp.down_proj.weight"].shape == (shape.width, shape.inner)
    model = onnx.load(EMBEDDED_FOLDER / "model.onnx")  # pyright: ignore[reportUnknownMemberType]
    stored = {each.name: numpy_helper.to_array(each) for each in model.graph.initializer}
    packed = stored["model.layers.0.attn.qkv_proj.MatMul.weight_Q8"].astype(np.int16) - 128
    whole = (packed * stored["model.layers.0.attn.qkv_proj.MatMul.weight_scales"][..., None]).reshape(len(packed), -1)
    parts = [weights[f"model.layers.0.self_attn.{one}_proj.weight"] for one in "qkv"]
    assert np.array_equal(np.concatenate(parts), whole.astype(np.float32))
    assert weights["lm_head.weight"] is weights["model.embed_tokens.weight"]


def test_rounded_blocks_are_read_as_the_library_wrote_them() -> None:
    """The output matrix, which the library rounded from the embedding, is the embedding again within half a step."""
    model = onnx.load(EMBEDDED_FOLDER / "model.onnx")  # pyright: ignore[reportUnknownMemberType]
    stored = {each.name: numpy_helper.to_array(each) for each in model.graph.initializer}
    packed, scales = stored["lm_head.MatMul.weight_Q8"], stored["lm_head.MatMul.weight_scales"]
    whole = stored["model.embed_tokens.weight"]
    rows, columns = whole.shape
    values = unpacked(packed, scales, {"bits": 8, "K": columns, "N": rows})
    steps = np.abs(scales).repeat(32, axis=1).reshape(rows, -1)[:, :columns]
    assert (np.abs(values - whole) <= 0.51 * steps + 1e-7).mean() > 0.999


def test_two_values_of_four_bits_share_a_byte_the_lower_one_first() -> None:
    """0x90 is the values 0 and 9, each less 8."""
    packed = np.array([[[0x90, 0x8F]]], dtype=np.uint8)
    values = unpacked(packed, np.array([[0.5]], dtype=np.float32), {"bits": 4, "K": 3, "N": 1})
    assert values.tolist() == [[-4.0, 0.5, 3.5]]


def test_what_is_no_planner_is_told(tmp_path: Path) -> None:
    """An empty folder has no model; a damaged or foreign one is reported by what is wrong with it."""
    with pytest.raises(NotFoundError, match=r"has no model\.onnx"):
        read_weights(tmp_path)
    folder = tmp_path / "model"
    shutil.copytree(EMBEDDED_FOLDER, folder)
    config = json.loads((folder / "genai_config.json").read_text())
    config["model"]["decoder"]["num_hidden_layers"] = 7
    (folder / "genai_config.json").write_text(json.dumps(config))
    with pytest.raises(PayloadError, match="57 weights where a Llama model of 7 layers has 66"):
        read_weights(folder)
    (folder / "model.onnx").write_bytes(b"\x00no protobuf")
    with pytest.raises(PayloadError, match="no planner that training can go on from"):
        read_weights(folder)
