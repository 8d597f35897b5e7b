"""Completes names while an instruction is written: robots, places and skills of this fleet, case ignored."""

from collections.abc import Iterable

MOST_WORDS = 4
"""Words of a name that may have been written already: "the north cold store"."""


def completions(text: str, names: Iterable[str], *, most: int = 20) -> tuple[str, ...]:
    """Return texts that complete the end of `text` by a name, the likeliest first; none when nothing is begun there.

    Names of several words ("dock 3") are completed from any of their words on. A name that stands there whole already
    is none.
    """
    if not text or text[-1].isspace():
        return ()
    known = sorted(set(names), key=lambda each: (len(each), each))
    words = text.split(" ")
    found: list[str] = []
    # The longest beginning first: what was written of "cold st" means the cold store rather than the station.
    for count in range(min(MOST_WORDS, len(words)), 0, -1):
        begun = " ".join(words[-count:])
        bare = begun.lstrip("(\"'")
        before = text[: len(text) - len(bare)]
        for name in known:
            if bare and name.lower().startswith(bare.lower()) and len(name) > len(bare):
                made = before + name
                if made not in found:
                    found.append(made)
    return tuple(found[:most])


def common(found: Iterable[str]) -> str:
    """Return the longest beginning that all of them share, by which Tab goes on when there are several."""
    found = list(found)
    if not found:
        return ""
    low, high = min(found), max(found)
    for place, each in enumerate(low):
        if place >= len(high) or each != high[place]:
            return low[:place]
    return low
