"""correct_text: a transcript with its misheard words put right, by which words follow which in orders to robots."""

from typing import Any

from _lib import params
from _lib.context import Context, Surroundings
from _lib.learning import language
from _lib.learning.language import Language

FILE = "models/sentences/language.json"
DICTIONARY = "pocketsphinx"
"""A recogniser that writes only words of a dictionary."""


def preload(ctx: Surroundings) -> Language:
    """Read the language once."""
    return language.read(ctx.folder.parent / FILE)


def run(ctx: Context) -> dict[str, Any]:
    """Return text, what it was before, and each change."""
    given = [
        table
        for table in map(params.table, ctx.inputs.values())
        if isinstance(table.get("text"), str) and table.get("skill") != "correct_text"
    ]
    if not given:
        raise ctx.CallError("precondition", "no text was handed on", "transcribe in a subtask before this one")
    heard = " ".join(str(given[-1]["text"]).upper().split())
    known: Language = ctx.preloaded or preload(ctx)
    channel = language.WORDS if given[-1].get("recogniser") == DICTIONARY else language.LETTERS
    found = language.correct(heard, known, channel)
    changes = [{"heard": said, "meant": meant} for said, meant in found.changes]
    return {"text": found.text, "before": heard, "changes": changes}
