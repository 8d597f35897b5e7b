"""The client library as a robot's companion computer has it: without the appliance, and without what that needs."""

import subprocess
import sys
from pathlib import Path

_ALONE = """
import sys

ALLOWED = {"appliance", "appliance.robots", "appliance.robots.mavlink", "appliance.robots.mavlink.tunnel",
           "appliance.robots.client", "appliance.robots.zenoh_client", *sys.argv[1:]}


class Blocker:
    def find_spec(self, name, path=None, target=None):
        root = name.partition(".")[0]
        if root == "appliance" and name not in ALLOWED:
            raise ImportError(f"{name} is not on this robot")
        if root not in sys.stdlib_module_names and root != "appliance" and root not in ALLOWED:
            raise ImportError(f"{name} is not installed on this robot")
        return None


sys.meta_path.insert(0, Blocker())
from appliance.robots.client import AsyncTaskClient, AsyncZenohTaskClient, TaskClient, ZenohTaskClient
for robot_needs in sys.argv[1:]:
    __import__(robot_needs)
print(TaskClient.__name__, AsyncTaskClient.__name__, ZenohTaskClient.__name__, AsyncZenohTaskClient.__name__)
"""


def test_nothing_of_the_appliance_is_needed(project_root: Path) -> None:
    """With everything else blocked, and every package but pymavlink or eclipse-zenoh, all four clients are there."""
    for needs in ((), ("pymavlink", "fastcrc"), ("zenoh",)):
        done = subprocess.run(
            [sys.executable, "-c", _ALONE, *needs], cwd=project_root, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == ["TaskClient", "AsyncTaskClient", "ZenohTaskClient", "AsyncZenohTaskClient"]
