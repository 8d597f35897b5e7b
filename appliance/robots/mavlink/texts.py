"""STATUSTEXT: what people at ground stations read."""

import secrets

from appliance.robots.mavlink.dialect import Message, make

INFO, NOTICE, WARNING, ERROR = 6, 5, 4, 3
"""MAV_SEVERITY."""
PART = 50
"""Characters of one STATUSTEXT."""
MOST = 4 * PART
"""Characters of a text that is sent: longer ones are cut, and end with `...`."""


def statustext(text: str, severity: int) -> list[Message]:
    """Return a text as at most five parts; ASCII, since displays on radios know no other."""
    data = text.encode("ascii", "replace")
    if len(data) > MOST:
        data = data[: MOST - 4].rstrip() + b"..."  # the last part is then not full
    return parts(data, severity)


def parts(data: bytes, severity: int) -> list[Message]:
    """Return a text as it is in parts with a common id, none where one is enough.

    A part that is not full ends a text, so one whose last part is full has an empty one behind it (MAVLink,
    STATUSTEXT).
    """
    if len(data) <= PART:
        return [make("STATUSTEXT", severity=severity, text=data, id=0, chunk_seq=0)]
    number = 1 + secrets.randbelow(65_535)
    return [
        make("STATUSTEXT", severity=severity, text=data[at : at + PART], id=number, chunk_seq=at // PART)
        for at in range(0, len(data) + 1, PART)
    ]
