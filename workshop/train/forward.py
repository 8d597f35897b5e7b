# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""The loss of a Llama model on the answers alone, computed with as little as that needs.

The library's own pass computes each layer and the logits for all tokens of the prompt too. Here the end of the last
layer and the logits are computed for the answers' tokens only (a fifth of all), projections that read the same input
are one product, and products are bfloat16. The weights are the library's model's own, so what is trained here is saved,
exported and run as any Llama model.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from workshop.train.fit import IGNORED

HALF = torch.bfloat16


class AnswerLoss:
    """Computes the loss.

    Args:
        model: a LlamaForCausalLM with tied embeddings.
        compiled: whether the layers are compiled first; takes a minute or two and a C++ compiler.
    """

    def __init__(self, model: Any, *, compiled: bool) -> None:
        config = model.config
        if not config.tie_word_embeddings or config.attention_bias or config.mlp_bias:
            raise ValueError("a Llama model with tied embeddings and no biases is needed")
        self._model = model
        self._heads, self._key_heads = config.num_attention_heads, config.num_key_value_heads
        self._size = config.hidden_size // config.num_attention_heads
        self._eps = config.rms_norm_eps
        places = torch.arange(config.max_position_embeddings, dtype=torch.float32)
        rates = model.model.rotary_emb.inv_freq.detach().float().cpu()
        angles = torch.outer(places, rates).repeat(1, 2).to(next(model.parameters()).device)
        self._cos, self._sin = angles.cos(), angles.sin()
        self._attend: Callable[..., Tensor] = _attend
        self._mix: Callable[..., Tensor] = _mix
        if compiled:
            self._attend = torch.compile(_attend, dynamic=True)
            self._mix = torch.compile(_mix, dynamic=True)

    def __call__(self, inputs: Tensor, labels: Tensor, *, dropout: float = 0.0) -> Tensor:
        """Return the mean cross-entropy over the answers' tokens.

        Args:
            inputs: tokens [rows, length], padded behind.
            labels: the same shape; IGNORED wherever no answer is.
            dropout: share of the embeddings, and of what each layer adds, that is left out at random.
        """
        body = self._model.model
        length = inputs.shape[1]
        cos, sin = self._cos[:length], self._sin[:length]
        targets = labels[:, 1:].reshape(-1)
        wanted = torch.nn.functional.pad(labels[:, 1:] != IGNORED, (0, 1)).reshape(-1).nonzero().squeeze(1)
        x = functional.dropout(functional.embedding(inputs, body.embed_tokens.weight), dropout)
        width = x.shape[-1]
        last = len(body.layers) - 1
        for number, layer in enumerate(body.layers):
            attention, mlp = layer.self_attn, layer.mlp
            seen = self._attend(
                x,
                cos,
                sin,
                layer.input_layernorm.weight,
                torch.cat((attention.q_proj.weight, attention.k_proj.weight, attention.v_proj.weight)).to(HALF),
                self._heads,
                self._key_heads,
                self._size,
                self._eps,
            )
            x, seen = x.reshape(-1, width), seen.reshape(-1, seen.shape[-1])
            if number == last:
                x, seen = x.index_select(0, wanted), seen.index_select(0, wanted)
            x = self._mix(
                x,
                seen,
                attention.o_proj.weight.to(HALF),
                layer.post_attention_layernorm.weight,
                torch.cat((mlp.gate_proj.weight, mlp.up_proj.weight)).to(HALF),
                mlp.down_proj.weight.to(HALF),
                self._eps,
                dropout,
            )
            if number != last:
                x = x.reshape(*inputs.shape, width)
        logits = functional.linear(_norm(x, body.norm.weight, self._eps), body.embed_tokens.weight.to(HALF))
        return functional.cross_entropy(logits.float(), targets[targets != IGNORED])


def _norm(x: Tensor, weight: Tensor, eps: float) -> Tensor:
    return (x * torch.rsqrt(x.square().mean(-1, keepdim=True) + eps) * weight).to(HALF)


def _turned(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Return [rows, heads, length, size] turned by position, as Llama does (halves, not pairs)."""
    one, two = x.float().chunk(2, dim=-1)
    return (torch.cat((one, two), -1) * cos + torch.cat((-two, one), -1) * sin).to(HALF)


def _attend(
    x: Tensor, cos: Tensor, sin: Tensor, norm: Tensor, qkv: Tensor, heads: int, key_heads: int, size: int, eps: float
) -> Tensor:
    rows, length, _ = x.shape
    made = functional.linear(_norm(x, norm, eps), qkv).view(rows, length, heads + 2 * key_heads, size).transpose(1, 2)
    q, k, v = made.split((heads, key_heads, key_heads), dim=1)
    times = heads // key_heads
    k, v = _turned(k, cos, sin).repeat_interleave(times, dim=1), v.repeat_interleave(times, dim=1)
    # Written out: for short rows on a processor this takes a fifth of the time of scaled_dot_product_attention.
    scores = (_turned(q, cos, sin) * size**-0.5) @ k.transpose(-1, -2)
    later = torch.ones(length, length, dtype=torch.bool, device=x.device).triu(1)
    seen = scores.masked_fill(later, -torch.inf).softmax(-1) @ v
    return seen.transpose(1, 2).reshape(rows, length, heads * size)


def _mix(
    x: Tensor, seen: Tensor, out: Tensor, norm: Tensor, gate_up: Tensor, down: Tensor, eps: float, dropout: float
) -> Tensor:
    x = x + functional.dropout(functional.linear(seen, out).float(), dropout)
    gate, up = functional.linear(_norm(x, norm, eps), gate_up).chunk(2, dim=-1)
    return x + functional.dropout(functional.linear(functional.silu(gate) * up, down).float(), dropout)
