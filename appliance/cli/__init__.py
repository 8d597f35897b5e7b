"""`swiftbot …`: parses arguments and prints; the work is done in the rooms.

What it ends with is one of `appliance.errors.Exit`.
"""

import sys

from cyclopts import App, CycloptsError
from rich.markup import escape

from appliance import console, logs
from appliance.cli import daemons, log, plan, plane, plugins, pool, robots, steer, task, tools
from appliance.errors import Exit, SwiftbotError

app = App(
    name="swiftbot", help="SwiftBot gateway: instructions to a robot fleet, run in warm containers.", version="0.1.0"
)
for part in (task, plan, steer, daemons, pool, robots, log, plane, tools, plugins):
    part.add_to(app)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: run a command and end with its exit code."""
    # Commands speak for themselves; daemons set up their own logging when they start.
    logs.configure(level="warning", style="text")
    try:
        code = app(arguments, exit_on_error=False, print_error=True, result_action="return_value")
        code = code if isinstance(code, int) else Exit.DONE
    except CycloptsError:
        code = Exit.USAGE
    except SwiftbotError as error:
        # Messages hold what people and robots wrote: brackets in them are no markup.
        console.err.print(f"[red]error:[/red] {escape(error.message)}", markup=True)
        if error.remedy:
            console.err.print(f"  remedy: {error.remedy}", markup=False)
        code = error.exit_code
    except KeyboardInterrupt:
        code = Exit.INTERRUPTED
    sys.exit(code)
