"""STATUSTEXT: what people at ground stations read."""

import secrets

from appliance.robots.mavlink.dialect import Message, make

INFO, NOTICE, WARNING, ERROR = 6, 5, 4, 3
"""MAV_SEVERITY."""
_TEXT = 50
"""Characters of one STATUSTEXT."""
_PARTS = 4


def statustext(text: str, severity: int) -> list[Message]:
    """Return a text as at most four parts; ASCII, since displays on radios know no other."""
    data = text.encode("ascii", "replace")[: _PARTS * _TEXT]
    number = 0 if len(data) <= _TEXT else 1 + secrets.randbelow(65_535)
    return [
        make("STATUSTEXT", severity=severity, text=data[at : at + _TEXT], id=number, chunk_seq=at // _TEXT)
        for at in range(0, max(1, len(data)), _TEXT)
    ]
