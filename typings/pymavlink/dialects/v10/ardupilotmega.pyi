"""What is used of pymavlink's dialect of MAVLink 1."""

from typing import Any

mavlink_map: dict[int, Any]
