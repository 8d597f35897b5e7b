"""What is used of pymavlink's generated dialect: reading its 33,000 lines took a quarter of the whole type check."""

from collections.abc import Callable
from typing import Any

mavlink_map: dict[int, Any]
enums: dict[str, dict[int, Any]]
mcrf4xx: Callable[[bytes], int] | None

class x25crc:  # noqa: N801 - its name
    crc: int
    def __init__(self, buf: bytes = ...) -> None: ...

class MAVLink:
    def __init__(self, file: Any, srcSystem: int = ..., srcComponent: int = ...) -> None: ...  # noqa: N803 - their names
