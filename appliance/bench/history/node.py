"""A gateway with nothing but its plane, as a process: `python -m appliance.bench.history.node FILE` with its settings.

Records need no pool and no tasks; without them a fleet of such gateways starts in a second and leaves the machine to
what is tested.
"""

import asyncio
import signal
import sys
from pathlib import Path

from appliance import config as configuration
from appliance import logs
from appliance.plane.node import Plane


async def main(path: Path) -> None:
    """Run until SIGTERM."""
    config = configuration.load(path)
    logs.configure(level=config.log_level, style=config.log_format)
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    plane = await Plane.open(config.plane, fleet=config.fleet, gateway=config.id, data_dir=Path(config.data_dir))
    try:
        await stop.wait()
    finally:
        await plane.close()


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1])))
