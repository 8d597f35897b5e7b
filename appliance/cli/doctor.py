"""`swiftbot doctor`: checks of this machine."""

from pathlib import Path

from cyclopts import App

from appliance import console
from appliance.cli.common import TOOLS, Json, show
from appliance.errors import Exit


def add_to(app: App) -> None:
    """Add this command."""
    app.command(doctor, group=TOOLS)


async def doctor(*, config: Path | None = None, as_json: Json = False) -> int:
    """Check everything this machine needs; each failed check names its fix.

    Args:
        config: A gateway's TOML file, to check its ports and folders too.
    """
    from appliance import config as configuration
    from appliance.doctor import run_checks

    checks = await run_checks(configuration.load(config) if config else None)
    show(checks, as_json=as_json, table=console.check_table(checks))
    return Exit.DONE if all(check.ok or not check.required for check in checks) else Exit.MISSING
