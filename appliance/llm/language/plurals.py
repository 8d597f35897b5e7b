"""One of several: what a name in the plural is in the singular, for names as people give them to things and places."""

_F = frozenset({"shelves", "halves", "calves", "leaves", "loaves", "wolves", "thieves", "scarves", "hooves", "sheaves"})
_FE = frozenset({"knives", "wives", "lives"})
_IE = frozenset(
    {"cookies", "brownies", "movies", "smoothies", "hoodies", "selfies", "pies", "ties", "zombies", "veggies"}
)
_OTHERS = {
    "shoes": "shoe",
    "horseshoes": "horseshoe",
    "snowshoes": "snowshoe",
    "toes": "toe",
    "canoes": "canoe",
    "hoes": "hoe",
    "buses": "bus",
    "minibuses": "minibus",
    "gases": "gas",
    "lenses": "lens",
    "viruses": "virus",
    "axes": "axe",
    "series": "series",
    "species": "species",
}


def singular(text: str) -> str:
    """Return a name with its last word in the singular, and without the 's of its owner.

    Args:
        text: lower case; its last word is taken to be regular, or one of the common others.
    """
    if text.endswith("'s"):
        return text[:-2]
    before, blank, word = text.rpartition(" ")
    return f"{before}{blank}{_one(word)}"


def _one(word: str) -> str:
    if (other := _OTHERS.get(word)) is not None:
        return other
    if word in _F:
        return f"{word[:-3]}f"
    if word in _FE:
        return f"{word[:-3]}fe"
    if word.endswith("shelves"):
        return f"{word[:-3]}f"
    if word.endswith("ies") and len(word) > 4:
        return word[:-1] if word in _IE else f"{word[:-3]}y"
    if word.endswith(("ches", "shes", "xes", "sses", "oes")):
        return word[:-2]
    return word[:-1] if word.endswith("s") and not word.endswith("ss") else word
