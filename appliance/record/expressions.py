"""Key expressions against keys, without a Zenoh session: logs are read where no network is.

Zenoh's rules: `*` is one chunk, `**` any number of chunks (none too), `$*` any text within a chunk.
"""

import re
from functools import lru_cache


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


def matches(expression: str, key: str) -> bool:
    """Whether `expression` includes `key`."""
    return compile_expression(expression).fullmatch(key) is not None
