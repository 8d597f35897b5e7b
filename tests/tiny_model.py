"""Builds the smallest model folder that onnxruntime-genai loads: one attention layer, random weights, a byte tokenizer.

Why: the local slot must be tested against the real library, and no model may be fetched for it. Random weights do: the
grammar forces a valid plan out of any model, which is what the tests show. Takes a second.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from tokenizers import Tokenizer, decoders, models, pre_tokenizers

from appliance.skills.catalogue import Catalogue
from workshop.train.card import card_of, write_card
from workshop.train.tokens import BEGIN, END, Tokens

HIDDEN = 32
HEADS = 2
HEAD = HIDDEN // HEADS
CONTEXT = 32768
TERSE = '}]"'
"""Ends objects, lists and texts as soon as it may."""
WORDY = ',"'
"""Goes on with lists as long as it may, and ends texts at once."""
SPECIALS = ("<|end|>", "<|pad|>")


def build(folder: Path, *, seed: int = 7, like: str = TERSE, speaks: Catalogue | None = None) -> Path:
    """Write the model into `folder` (made if need be) and return it.

    Args:
        folder: where to.
        seed: of the weights.
        like: symbols it prefers, the first most; `TERSE` makes short plans, `WORDY` long ones.
        speaks: makes a model that writes the plan language over this catalogue; it likes to end.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if speaks is not None:
        tokens = Tokens.learn(["rex", "fetch", "drill"], speaks, size=1200)
        tokens.save(folder)
        _tokenizer_config(folder, BEGIN, END)
        card = card_of(tokens, speaks)
        write_card(folder, card)
        bias = np.zeros(tokens.size, dtype=np.float32)
        bias[card.tokens[END]] = 3.0
        _decoder(folder / "model.onnx", tokens.size, np.random.default_rng(seed), bias)
        _config(folder, tokens.size, end=card.tokens[END], pad=0)
        return folder
    size = _tokenizer(folder)
    bias = np.zeros(size, dtype=np.float32)
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    for place, symbol in enumerate(reversed(like)):
        bias[alphabet.index(symbol)] = 30.0 * (place + 1)
    _decoder(folder / "model.onnx", size, np.random.default_rng(seed), bias)
    _config(folder, size, end=size - 2, pad=size - 1)
    return folder


def _config(folder: Path, size: int, *, end: int, pad: int) -> None:
    config = {
        "model": {
            "bos_token_id": end,
            "eos_token_id": end,
            "pad_token_id": pad,
            "context_length": CONTEXT,
            "type": "llama",
            "vocab_size": size,
            "decoder": {
                "session_options": {"log_id": "onnxruntime-genai", "provider_options": []},
                "filename": "model.onnx",
                "head_size": HEAD,
                "hidden_size": HIDDEN,
                "inputs": {
                    "input_ids": "input_ids",
                    "attention_mask": "attention_mask",
                    "past_key_names": "past_key_values.%d.key",
                    "past_value_names": "past_key_values.%d.value",
                },
                "outputs": {
                    "logits": "logits",
                    "present_key_names": "present.%d.key",
                    "present_value_names": "present.%d.value",
                },
                "num_attention_heads": HEADS,
                "num_hidden_layers": 1,
                "num_key_value_heads": HEADS,
            },
        },
        "search": {
            "do_sample": False,
            "max_length": CONTEXT,
            "min_length": 0,
            "num_beams": 1,
            "num_return_sequences": 1,
            "past_present_share_buffer": False,
            "temperature": 1.0,
            "top_k": 1,
            "top_p": 1.0,
        },
    }
    (folder / "genai_config.json").write_text(json.dumps(config, indent=1))


def _tokenizer(folder: Path) -> int:
    """Write a byte-level BPE tokenizer with the 256 bytes and a few merges; return the vocabulary's size."""
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    merges = [
        ("g", "o"),
        ("t", "o"),
        ("go", "to"),
        ("s", "k"),
        ("i", "l"),
        ("sk", "il"),
        ("skil", "l"),
        ('"', ","),
        ('"', ":"),
    ]
    vocabulary = {symbol: index for index, symbol in enumerate(alphabet)}
    for left, right in merges:
        vocabulary[left + right] = len(vocabulary)
    tokenizer = Tokenizer(models.BPE(vocab=vocabulary, merges=merges))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens(list(SPECIALS))
    tokenizer.save(str(folder / "tokenizer.json"))
    _tokenizer_config(folder, *SPECIALS[::-1])
    return tokenizer.get_vocab_size(with_added_tokens=True)


def _tokenizer_config(folder: Path, pad: str, end: str) -> None:
    (folder / "tokenizer_config.json").write_text(
        json.dumps(
            {
                "tokenizer_class": "PreTrainedTokenizerFast",
                "bos_token": None,
                "eos_token": end,
                "pad_token": pad,
                "add_bos_token": False,
                "clean_up_tokenization_spaces": False,
                "model_max_length": CONTEXT,
            }
        )
    )


def _decoder(file: Path, size: int, random: np.random.Generator, bias: np.ndarray) -> None:
    def weight(name: str, *shape: int) -> onnx.TensorProto:
        return numpy_helper.from_array((random.standard_normal(shape) * 0.4).astype(np.float32), name)

    past = ["batch_size", HEADS, "past_sequence_length", HEAD]
    present = ["batch_size", HEADS, "total_sequence_length", HEAD]

    def tensor(name: str, kind: int, shape: list[Any]) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, kind, shape)

    nodes = [
        helper.make_node("Gather", ["embedding", "input_ids"], ["embedded"]),
        *(helper.make_node("MatMul", ["embedded", f"w_{part}"], [part]) for part in ("query", "key", "value")),
        helper.make_node("ReduceSum", ["attention_mask", "axis_1"], ["lengths"], keepdims=1),
        helper.make_node("Sub", ["lengths", "one"], ["last"]),
        helper.make_node("Cast", ["last"], ["seqlens_k"], to=TensorProto.INT32),
        helper.make_node("Shape", ["attention_mask"], ["mask_shape"]),
        helper.make_node("Gather", ["mask_shape", "index_1"], ["total"], axis=0),
        helper.make_node("Cast", ["total"], ["total_length"], to=TensorProto.INT32),
        helper.make_node(
            "GroupQueryAttention",
            ["query", "key", "value", "past_key_values.0.key", "past_key_values.0.value", "seqlens_k", "total_length"],
            ["attended", "present.0.key", "present.0.value"],
            domain="com.microsoft",
            num_heads=HEADS,
            kv_num_heads=HEADS,
        ),
        helper.make_node("Add", ["embedded", "attended"], ["mixed"]),
        helper.make_node("MatMul", ["mixed", "w_out"], ["scores"]),
        helper.make_node("Add", ["scores", "bias"], ["logits"]),
    ]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [
            tensor("input_ids", TensorProto.INT64, ["batch_size", "sequence_length"]),
            tensor("attention_mask", TensorProto.INT64, ["batch_size", "total_sequence_length"]),
            tensor("past_key_values.0.key", TensorProto.FLOAT, past),
            tensor("past_key_values.0.value", TensorProto.FLOAT, past),
        ],
        [
            tensor("logits", TensorProto.FLOAT, ["batch_size", "sequence_length", size]),
            tensor("present.0.key", TensorProto.FLOAT, present),
            tensor("present.0.value", TensorProto.FLOAT, present),
        ],
        [
            weight("embedding", size, HIDDEN),
            *(weight(f"w_{part}", HIDDEN, HIDDEN) for part in ("query", "key", "value")),
            weight("w_out", HIDDEN, size),
            numpy_helper.from_array(bias, "bias"),
            numpy_helper.from_array(np.array([1], dtype=np.int64), "axis_1"),
            numpy_helper.from_array(np.array([1], dtype=np.int64), "one"),
            numpy_helper.from_array(np.array(1, dtype=np.int64), "index_1"),
        ],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 17), helper.make_opsetid("com.microsoft", 1)], ir_version=9
    )
    onnx.save(model, file)
