"""Records as tables: `swiftbot plane get` and `ls`."""

import msgspec
from rich.table import Table

from appliance.plane.dht import Copy, RecordPlace
from appliance.plane.records import Record
from appliance.records import Held


def place_table(record: Record, place: RecordPlace, how: str) -> Table:
    """A record's version, and its copies."""
    title = f"{record.key} at {_version(record.version)}, read from {how}; owner {place.owner}"
    table = Table(title=title, title_justify="left", caption=_caption(place), caption_justify="left")
    for name in ("gateway", "version", "bytes", "state"):
        table.add_column(name)
    for each in place.copies:
        table.add_row(each.gateway, _version(each.version), str(each.size_bytes), _state(each))
    return table


def _caption(place: RecordPlace) -> str:
    return "the copies agree" if place.agree else "the copies differ"


def held_table(held: list[Held]) -> Table:
    """Records and where their copies lie."""
    table = Table()
    for name in ("key", "version", "bytes", "owner", "copies at", ""):
        table.add_column(name)
    for each in held:
        newest = each.newest
        copies = ", ".join(copy.gateway for copy in each.copies)
        notes = [*(["removed"] if newest.deleted else []), *([] if each.agree else ["copies differ"])]
        row = (each.key, _version(newest.version), str(newest.size_bytes), each.owner, copies, ", ".join(notes))
        table.add_row(*row)
    return table


def _state(copy: Copy) -> str:
    if copy.problem:
        return copy.problem
    return "removed" if copy.deleted else "" if copy.version else "none"


def _version(version: dict[str, int]) -> str:
    return msgspec.json.encode(version).decode() if version else ""
