"""The page of the terminal UI says what the registry says."""

import subprocess
import sys
from pathlib import Path


def test_page_is_what_the_registry_says(project_root: Path) -> None:
    """The tables of docs/tui.md are made from the registry; `scripts/write_actions.py` makes them."""
    script = project_root / "scripts" / "write_actions.py"
    done = subprocess.run([sys.executable, str(script), "--check"], check=False)
    assert done.returncode == 0, "run scripts/write_actions.py"
