"""Foreign text as a model may be shown it: one line, cut, without what could pass for the prompt's own structure. Pure.

Names of places and objects and the reasons that robots give for a failure are written by others. A model may read an
order in them; what it makes of that is refused by `grounding` and the policy. Here they are made harmless as far as
form goes: no new line, no mark-up of a chat, no quotation mark that ends a quotation.
"""

import re
import unicodedata

MOST = 80
_MARKUP = re.compile(r"<\|[^|]{0,40}\|>|</?s>|\[/?INST\]|###|```|^\s*(?:system|assistant|user)\s*:", re.IGNORECASE)


def quoted(text: str, most: int = MOST) -> str:
    """Return text to be shown as data."""
    plain = "".join(" " if unicodedata.category(each)[0] in "CZ" else each for each in text[: 4 * most])
    plain = _MARKUP.sub(" ", " ".join(plain.split())).replace('"', "'").replace("\\", "/")
    return " ".join(plain.split())[:most].rstrip()
