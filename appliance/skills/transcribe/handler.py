"""transcribe: speech into text, by the network that `swiftbot learn` trains as `sentences`, else by pocketsphinx."""

from typing import Any

from _lib import params, pictures
from _lib.context import Context
from _lib.learning import recordings, sounds, sphinx, training, work
from _lib.learning.training import Network

MODEL = "sentences"
LONGEST = 60 * sounds.RATE
"""Samples that are looked at together."""


def run(ctx: Context) -> dict[str, Any]:
    """Return text, the text of each recording, and which recogniser wrote it."""
    given = list(pictures.references(_latest(ctx), "audio/"))
    if not given:
        raise ctx.CallError("precondition", "no recording was handed on", "record sound in a subtask before this one")
    training.set_threads()
    model = work.model_of(ctx, MODEL)
    values = work.trained(ctx, model, model.tensors(len(work.class_names(ctx, model))))
    module: Network = None
    symbols = work.class_names(ctx, model)
    if values is not None:
        module = training.build(model, len(symbols))
        training.put(module, values)
    else:
        ctx.progress(0.0, "no trained model here: pocketsphinx is loaded")
    decoder = sphinx.Decoder(ctx) if module is None else None
    texts: list[str] = []
    for number, reference in enumerate(given, start=1):
        name = str(reference.get("name", "recording"))
        wave = recordings.wave(ctx, ctx.get_artifact(reference), name)
        parts = [wave[at : at + LONGEST] for at in range(0, len(wave), LONGEST)]
        said = [
            decoder.hear(part) if decoder else training.transcribe(module, sounds.log_mel(part), symbols)
            for part in parts
        ]
        texts.append(" ".join(text for text in said if text))
        ctx.progress(number / len(given), f"{number} of {len(given)} recordings")
    text = " ".join(each for each in texts if each)
    result = {"text": text, "texts": texts, "recogniser": "pocketsphinx" if decoder else MODEL}
    return result if text else result | {"note": "nothing was understood"}


def _latest(ctx: Context) -> dict[str, Any]:
    """Return what was handed on: of a recording that was preprocessed, only the segments."""
    cleaned = {
        name: result for name, result in ctx.inputs.items() if params.table(result).get("skill") == "preprocess_audio"
    }
    return cleaned or ctx.inputs
