"""Reads the weights back out of a model folder, so that training can go on from a planner without the run it came from.

The library's builder writes the layers' matrices in blocks of small integers with a scale each (the operator
MatMulNBits of ONNX Runtime: value = scale * (integer - 2^(bits - 1))), the query, key and value matrices as one, and
the embedding, which is tied to the output, as floats. What the rounding took is lost; training gives it back.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import numpy_helper

from appliance.errors import NotFoundError, PayloadError

MODEL = "model.onnx"
_MATRIX = re.compile(r"model\.layers\.(\d+)\.(attn|mlp)\.(\w+)\.MatMul\.weight_Q[48]")
_NORM = re.compile(r"model\.layers\.(\d+)\.(input_layernorm|post_attention_layernorm|final_norm_layernorm)\.weight")

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]


@dataclass(frozen=True, kw_only=True)
class Shape:
    """How large a model is, in the words of a training recipe."""

    width: int
    layers: int
    heads: int
    key_heads: int
    inner: int


def is_model(folder: Path) -> bool:
    """Whether this is a model's folder (rather than that of a training run)."""
    return (folder / MODEL).is_file()


def read_weights(folder: Path) -> tuple[Shape, dict[str, Floats]]:
    """Return how large the model in a folder is, and its weights by the names that `transformers` gives a Llama model.

    Raises:
        NotFoundError: there is no model in that folder.
        PayloadError: it is not a Llama model with tied embeddings in blocks of 4 or 8 bits, as `export` makes them.
    """
    if not is_model(folder):
        raise NotFoundError(f"{folder} has no {MODEL}", remedy="give a training run, a model folder, or `embedded`")
    try:
        model = _load(folder / MODEL)
        config = json.loads((folder / "genai_config.json").read_text())["model"]["decoder"]
        heads, key_heads = int(config["num_attention_heads"]), int(config["num_key_value_heads"])
        layers, size = int(config["num_hidden_layers"]), int(config["head_size"])
        weights = _named(model, layers, heads * size, key_heads * size)
        shape = Shape(
            width=heads * size,
            layers=layers,
            heads=heads,
            key_heads=key_heads,
            inner=len(weights["model.layers.0.mlp.up_proj.weight"]),
        )
    except (OSError, KeyError, ValueError, DecodeError, onnx.checker.ValidationError) as error:
        raise PayloadError(
            f"{folder} is no planner that training can go on from: {type(error).__name__}: {error}",
            remedy="give a folder that `swiftbot train export` made with int4 or int8, or the run it came from",
        ) from error
    return shape, weights


def _load(path: Path) -> onnx.ModelProto:
    return onnx.load(path)  # pyright: ignore[reportUnknownMemberType]


def _named(model: onnx.ModelProto, layers: int, queries: int, keys: int) -> dict[str, Floats]:
    stored = {each.name: each for each in model.graph.initializer}
    attributes = {
        node.input[1]: {each.name: each.i for each in node.attribute}
        for node in model.graph.node
        if node.op_type == "MatMulNBits"
    }
    found: dict[str, Floats] = {}
    for name, tensor in stored.items():
        if (norm := _NORM.fullmatch(name)) is not None:
            number, kind = int(norm[1]), norm[2]
            place = "model.norm" if kind == "final_norm_layernorm" else f"model.layers.{number}.{kind}"
            found[f"{place}.weight"] = _floats(tensor)
        elif (matrix := _MATRIX.fullmatch(name)) is not None:
            scales = stored[re.sub(r"_Q[48]$", "_scales", name)]
            values = unpacked(numpy_helper.to_array(tensor), _floats(scales), attributes[name])
            where = f"model.layers.{matrix[1]}.{'self_attn' if matrix[2] == 'attn' else 'mlp'}"
            if matrix[3] == "qkv_proj":
                parts = np.split(values, [queries, queries + keys])
                found |= {f"{where}.{one}_proj.weight": part for one, part in zip("qkv", parts, strict=True)}
            else:
                found[f"{where}.{matrix[3]}.weight"] = values
    found["model.embed_tokens.weight"] = found["lm_head.weight"] = _floats(stored["model.embed_tokens.weight"])
    if len(found) != 9 * layers + 3:
        raise ValueError(f"{len(found)} weights where a Llama model of {layers} layers has {9 * layers + 3}")
    return found


def _floats(tensor: onnx.TensorProto) -> Floats:
    return numpy_helper.to_array(tensor).astype(np.float32)


def unpacked(packed: "np.ndarray[Any, Any]", scales: Floats, attributes: dict[str, int]) -> Floats:
    """Return a matrix [rows, columns] of its rounded blocks; of two values of 4 bits in a byte the lower is the first.

    Args:
        packed: bytes [rows, blocks, bytes of a block].
        scales: as many as blocks.
        attributes: `bits` (4 or 8), `K` columns and `N` rows, as the operator MatMulNBits has them.

    Raises:
        ValueError: another number of bits.
    """
    bits, columns, rows = attributes["bits"], attributes["K"], attributes["N"]
    integers = packed.astype(np.int16)
    if bits == 4:
        integers = np.stack((integers & 15, integers >> 4), axis=-1).reshape(*packed.shape[:2], -1)
    elif bits != 8:
        raise ValueError(f"blocks of {bits} bits")
    values = (integers - (1 << (bits - 1))).astype(np.float32) * scales.reshape(*packed.shape[:2], 1)
    return values.reshape(rows, -1)[:, :columns]
