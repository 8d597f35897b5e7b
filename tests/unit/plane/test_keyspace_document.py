"""docs/keyspace.md says what the code does."""

import subprocess
import sys
from pathlib import Path

from appliance.plane.settings import PlaneConfig


def test_the_tables_are_made_of_the_table(project_root: Path) -> None:
    """Topics, verbs and records of docs/keyspace.md are those of `model.keyspace`."""
    script = project_root / "scripts" / "write_keyspace.py"
    done = subprocess.run([sys.executable, str(script), "--check"], check=False, cwd=project_root)
    assert done.returncode == 0, "run scripts/write_keyspace.py"


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
