"""The hand-written pairs as examples."""

from pathlib import Path

from appliance.skills.catalogue import Catalogue
from workshop import corpus
from workshop.corpus.notation import parse
from workshop.train.examples import Example, example_of


def corpus_examples(catalogue: Catalogue) -> list[Example]:
    """Return the examples of all hand-written pairs."""
    files = sorted(Path(corpus.__file__).parent.glob("*.plan"))
    return [example_of(pair, catalogue) for file in files for pair in parse(file.read_text(), name=file.name).values()]
