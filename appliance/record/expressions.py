"""Key expressions against keys, without a Zenoh session: logs are read where no network is.

Zenoh's rules: `*` is one chunk, `**` any number of chunks (none too), `$*` any text within a chunk.
"""

import re
from functools import lru_cache

from appliance.errors import ConfigError


@lru_cache(maxsize=1024)
def compile_expression(expression: str) -> re.Pattern[str]:
    """Return the pattern whose `fullmatch` accepts the keys that `expression` includes."""
    # Each chunk takes the slash after it or the end, so that `**` can stand for no chunk without a slash left over.
    out = ""
    for chunk in expression.split("/"):
        if chunk == "**":
            out += "(?:[^/]+(?:/|$))*"
        else:
            body = "[^/]+" if chunk == "*" else "[^/]*".join(re.escape(part) for part in chunk.split("$*"))
            out += f"{body}(?:/|$)"
    return re.compile(out)


def check_expression(expression: str) -> str:
    """Return a key expression that a person has written; ConfigError for one that would never match what is meant.

    Stars beside other text are those of a shell, not of Zenoh. Slashes are let through as they come: topics of other
    writers begin with one.
    """
    wrong = not expression or any(
        ("*" in chunk.replace("$*", "") and chunk not in ("*", "**")) or "$" in chunk.replace("$*", "") or "?" in chunk
        for chunk in expression.split("/")
    )
    if wrong:
        raise ConfigError(
            f"{expression[:80]!r} is no key expression",
            remedy="`*` is one chunk between slashes, `**` any number, `$*` any text within one: **/gw-$*/log",
        )
    return expression


def matches(expression: str, key: str) -> bool:
    """Whether `expression` includes `key`."""
    return compile_expression(expression).fullmatch(key) is not None
