"""The entry of a container: reads what it is to be, loads, serves.

python3 -m runner.main --socket /run/swiftbot/runner.sock --spec /run/swiftbot/spec.json
"""

import argparse
import sys
from pathlib import Path

from .preload import Loaded
from .spec import Spec
from .zygote import Zygote


def main() -> None:
    """Parse, load, serve."""
    parser = argparse.ArgumentParser(prog="runner")
    parser.add_argument("--socket", required=True)
    parser.add_argument("--spec", type=Path, required=True, help="JSON: skills, modules, site")
    parser.add_argument("--scratch", type=Path, default=Path("/tmp"))  # noqa: S108 - a tmpfs of this container alone
    parser.add_argument("--processes", type=int, default=0, help="most processes of the user; 0: not limited here")
    options = parser.parse_args()
    loaded = Loaded(Spec.read(options.spec))
    loaded.load()
    Zygote(options.socket, loaded, scratch=options.scratch, processes=options.processes).serve()
    sys.exit(0)


if __name__ == "__main__":
    main()
