"""What an operator orders of a gateway's local model over RPC.

llm_swap    SwapAsk -> Swapped    plan with another model folder from now on
"""

from typing import Annotated

from msgspec import Meta, Struct

from appliance.model import Signed


class SwapAsk(Signed, frozen=True, kw_only=True):
    """`llm_swap`: a folder on the asked gateway, made for onnxruntime-genai, or `embedded`."""

    folder: Annotated[str, Meta(min_length=1, max_length=1000)]


class Swapped(Struct, frozen=True, kw_only=True):
    """What a swap came to. It lasts until the gateway is restarted; `llm.local_model` is the lasting setting."""

    before: str
    """Folder name of the model before; empty: there was none."""
    after: str
    ms: float
    """From the order until the new one serves."""
    tests: tuple[str, ...]
    """What it made of each instruction of the self-test."""
