"""The path of an instruction through a gateway stays short."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.podman, pytest.mark.timeout(180)]


def test_few_changes_of_room_from_submit_to_result(podman: Path, project_root: Path) -> None:
    """One traced task enters another package 16 times at most; the second command to its robot goes as the first."""
    del podman
    script = project_root / "scripts" / "room_changes.py"
    traced = subprocess.run(
        (sys.executable, str(script), "--json"), capture_output=True, text=True, timeout=150, check=False
    )
    assert traced.returncode == 0, traced.stderr
    found = json.loads(traced.stdout[traced.stdout.index("{\n") :])
    assert found["state"] == "succeeded"
    entered = [visit["room"] for visit in found["visits"] if not visit["returned"]]
    assert {"floor", "llm", "pool", "robots", "tasks", "plane"} == set(entered)
    assert len(entered) - 1 == found["changes"]
    command = "tasks floor tasks robots plane"  # asked once more where the robot still carries it out
    once = re.sub(rf"{command}( plane)*( tasks)? floor tasks( robots)?( plane)?", command, " ".join(entered))
    assert len(once.split()) - 1 <= 16, entered
