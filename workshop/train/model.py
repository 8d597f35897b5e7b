# pyright: basic, reportMissingImports=false
# PyTorch is of the extra `train`, which neither gateways nor the development environment have.
"""What is trained: the recipe, the model it describes, and a run that begins with the weights of another.

Those may be another run's, or the ones of a model folder (`weights`): the embedded planner can be tuned where nobody
has the run that it came from.
"""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from transformers import LlamaConfig, LlamaForCausalLM

from appliance.errors import ConflictError, NotFoundError
from appliance.llm.decoder import read_card
from appliance.llm.settings import folder_of
from appliance.skills.catalogue import Catalogue
from workshop.train.ending import writing
from workshop.train.fit import CONTEXT
from workshop.train.tokens import BEGIN, END, PAD, Tokens
from workshop.train.weights import is_model, read_weights

CHECKPOINT = "checkpoint.pt"
RECIPE = "recipe.json"


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a model is made; kept beside it."""

    seed: int = 1
    width: int = 256
    layers: int = 6
    heads: int = 4
    key_heads: int = 2
    inner: int = 704
    batch_tokens: int = 4096
    steps: int = 8_000
    rate: float = 2e-3
    warmup: int = 200
    cooldown: float = 0.35
    """Share of the steps at the end in which the rate goes down."""
    decay: float = 0.1
    original: float = 0.1
    """Share of examples as they were written, without variation."""
    dropout: float = 0.0
    """Share of what a layer adds, and of a token's embedding, that is left out of a step, drawn for each."""
    twice: bool = False
    """Whether an instruction is read twice before it is answered (`tokens`)."""


def new_model(recipe: Recipe, tokens: Tokens) -> LlamaForCausalLM:
    """Return a model with random weights."""
    torch.manual_seed(recipe.seed)
    config = LlamaConfig(
        vocab_size=tokens.size,
        hidden_size=recipe.width,
        intermediate_size=recipe.inner,
        num_hidden_layers=recipe.layers,
        num_attention_heads=recipe.heads,
        num_key_value_heads=recipe.key_heads,
        max_position_embeddings=CONTEXT,
        tie_word_embeddings=True,
        rms_norm_eps=1e-5,
        bos_token_id=tokens.of(BEGIN),
        eos_token_id=tokens.of(END),
        pad_token_id=tokens.of(PAD),
    )
    return LlamaForCausalLM(config)


class Base:
    """Where another run begins: a run, a model folder, or `embedded`.

    Args:
        name: as it is given on the command line.
    """

    def __init__(self, name: str) -> None:
        self.folder = Path(folder_of(name))
        self.recipe = Recipe()
        self.state: dict[str, Any]
        """Weights by the names of `transformers`."""
        if (self.folder / CHECKPOINT).is_file():
            self.recipe = Recipe(**json.loads((self.folder / RECIPE).read_text()))
            self.state = torch.load(self.folder / CHECKPOINT, map_location="cpu", weights_only=True)["model"]
        elif is_model(self.folder):
            shape, weights = read_weights(self.folder)
            card = read_card(self.folder)
            self.recipe = replace(self.recipe, **asdict(shape), twice=card is not None and card.twice)
            self.state = {key: torch.from_numpy(each.copy()) for key, each in weights.items()}
        else:
            raise NotFoundError(
                f"{self.folder} is neither a training run nor a model",
                remedy="give a run, a model folder or `embedded`",
            )

    def prepare(self, folder: Path, catalogue: Catalogue, recipe: Recipe) -> None:
        """Lay out a run that begins with these weights, with tokens for skills that they do not know.

        A new token begins as the mean of all: as unlikely as any, and ready to be learned.

        Args:
            folder: of the new run; must not exist.
            catalogue: its skills.
            recipe: how it is trained; as large as this one is.

        Raises:
            ConflictError: there is such a folder already.
            PrerequisiteError: it cannot be written; nothing of it is left, so that the same can be asked again.
        """
        tokens = Tokens.load(self.folder).extended(catalogue)
        state = dict(self.state)
        for name in ("model.embed_tokens.weight", "lm_head.weight"):
            if name in state and tokens.size > len(state[name]):
                mean = state[name].mean(dim=0, keepdim=True)
                state[name] = torch.cat([state[name], mean.expand(tokens.size - len(state[name]), -1)])
        new_model(recipe, tokens).load_state_dict(state)  # it fits, or says what does not
        if folder.exists():
            raise ConflictError(f"{folder} is there already", remedy="name another folder, or remove that one")
        begun = {"optimisers": [], "step": 0, "group": 0, "inside": 0, "steps": recipe.steps, "cooling": False}
        with writing(f"{folder}", remedy="make room, or name a folder on another disk", unfinished=(folder,)):
            folder.mkdir(parents=True)
            tokens.save(folder)
            torch.save({"model": state, **begun}, folder / CHECKPOINT)
            # Last: a folder with a recipe is a run to go on with, and one without weights would begin at random.
            (folder / RECIPE).write_text(json.dumps(asdict(recipe), indent=1))
