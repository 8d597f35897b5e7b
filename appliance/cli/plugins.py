"""Commands that other installed packages add: entry points of the group `swiftbot.commands`.

An entry point names a function that takes the command line's `App` and adds its commands to it.
"""

from importlib.metadata import entry_points

from cyclopts import App

from appliance import console

GROUP = "swiftbot.commands"


def add_to(app: App) -> None:
    """Add the commands of all packages that offer some; one that cannot be loaded is named on stderr and left out."""
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        try:
            point.load()(app)
        except Exception as error:  # noqa: BLE001 - a broken package must not take the product's commands with it
            console.err.print(
                f"warning: the commands of {point.name} ({point.value}) are missing: {error!r}", markup=False
            )
