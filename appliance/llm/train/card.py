"""Writes what a model folder has beside the library's own files: `planner.json`."""

from pathlib import Path

import msgspec

from appliance.llm.language.words import MAX_WORDS
from appliance.llm.speaking import CARD, Card
from appliance.llm.train.tokens import BEGIN, END, PLAN, ROSTER, Tokens, symbols_of
from appliance.skills.catalogue import Catalogue


def card_of(tokens: Tokens, catalogue: Catalogue, *, calibration: tuple[float, float] = (1.0, 0.0)) -> Card:
    """Return the card of a tokenizer."""
    found = {each: tokens.of(each) for each in (BEGIN, END, ROSTER, PLAN)}
    found |= {f"w{number}": tokens.of(f"<w{number}>") for number in range(MAX_WORDS)}
    found |= {symbol: tokens.of(f"<{symbol}>") for symbol in symbols_of(catalogue)}
    return Card(language=1, tokens=found, calibration=calibration)


def write_card(folder: Path, card: Card) -> None:
    """Write the card into a model folder."""
    (folder / CARD).write_bytes(msgspec.json.format(msgspec.json.encode(card), indent=1))
