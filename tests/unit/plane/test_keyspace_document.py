"""docs/keyspace.md says what the code does."""

import inspect
import re
from pathlib import Path

from appliance.plane import anti_entropy, dht, leases, registry
from appliance.plane.keys import Keys
from appliance.plane.settings import PlaneConfig


def test_every_key_is_described(project_root: Path) -> None:
    """Each key name that the key space can make is in the document."""
    text = (project_root / "docs" / "keyspace.md").read_text()
    described = set(re.findall(r"`((?:gw|task|robot|world|notice|operator|recorder|@backlog)/[^`]+)`", text))
    described |= {f"recorder/{{recorder}}/{name}" for name in ("deleted", "log")}
    keys = Keys("f")
    for name, method in inspect.getmembers(keys, inspect.ismethod):
        if name.startswith("_") or name == "everything":
            continue
        arguments = {each: f"{{{each}}}" for each in inspect.signature(method).parameters}
        assert method(**arguments).removeprefix("swiftbot/f/") in described, name


def test_every_verb_of_the_plane_is_described(project_root: Path) -> None:
    """Each verb that the plane registers is in the document's table."""
    text = (project_root / "docs" / "keyspace.md").read_text()
    verbs = {
        verb
        for module in (dht, anti_entropy, dht, leases, dht, registry)
        for verb in re.findall(r'register\("(\w+)"', inspect.getsource(module))
    }
    assert len(verbs) == 12
    assert all(f"| `{verb}` |" in text for verb in verbs)


def test_the_limits_are_those_of_the_settings(project_root: Path) -> None:
    """The defaults named in the document are the settings' defaults."""
    text = (project_root / "docs" / "keyspace.md").read_text()
    config = PlaneConfig()
    assert f"`plane.max_payload_bytes` = {config.max_payload_bytes // 2**20} MiB" in text
    assert f"`plane.max_record_bytes` = {config.max_record_bytes // 2**20} MiB" in text
    assert f"{config.queue_messages:,} messages, {config.queue_bytes // 2**20} MiB" in text
    assert f"`plane.concurrent_queries` ({config.concurrent_queries})" in text
    assert f"`anti_entropy_s` = {config.anti_entropy_s:g} s" in text
    assert f"`replica_timeout_s` = {config.replica_timeout_s:g} s" in text
    assert f"`tombstone_hours` = {config.tombstone_hours:g} h" in text
