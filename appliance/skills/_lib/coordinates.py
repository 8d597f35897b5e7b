"""Coordinates in texts: the one reading of "12.5, 7", "(3, 4, 8)" or "x=3 y=4", for handlers and for the plan checks.

Only the standard library: handlers in their containers have nothing else.
"""

import re

_NUMBER = r"[-+−]?\d{1,6}(?:\.\d+)?"
COORDINATE = re.compile(
    rf"\(?\s*x?\s*=?\s*({_NUMBER})\s*m?\s*[,; ]\s*y?\s*=?\s*({_NUMBER})\s*m?"
    rf"(?:\s*[,; ]\s*z?\s*=?\s*({_NUMBER})\s*m?)?\s*\)?"
)


def read(text: str) -> tuple[float, float, float] | None:
    """Return x, y and z of the point that a text names, metres of the site; None for any other text.

    z is 0 where the text has two numbers.
    """
    match = COORDINATE.fullmatch(text.strip())
    if match is None:
        return None
    x, y, z = (float((each or "0").replace("−", "-")) for each in match.groups())
    return x, y, z
