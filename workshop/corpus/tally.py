"""What a corpus covers: how often each skill, domain, voice and length occurs."""

from collections import Counter
from collections.abc import Iterable

from msgspec import Struct, field

from workshop.corpus.notation import Pair


class Tally(Struct, frozen=True, kw_only=True):
    """Counts over pairs; `skills` counts the pairs a skill occurs in, `lengths` pairs by number of subtasks."""

    pairs: int
    skills: Counter[str] = field(default_factory=Counter[str])
    domains: Counter[str] = field(default_factory=Counter[str])
    voices: Counter[str] = field(default_factory=Counter[str])
    lengths: Counter[int] = field(default_factory=Counter[int])
    refused: Counter[str] = field(default_factory=Counter[str])


def tally(pairs: Iterable[Pair]) -> Tally:
    """Count what pairs cover."""
    listed = list(pairs)
    planned = [pair for pair in listed if not pair.refused]
    return Tally(
        pairs=len(listed),
        skills=Counter(skill for pair in planned for skill in {each.skill for each in pair.subtasks}),
        domains=Counter(pair.domain for pair in planned),
        voices=Counter(pair.voice for pair in listed),
        lengths=Counter(len(pair.subtasks) for pair in planned),
        refused=Counter(pair.refused for pair in listed if pair.refused),
    )
