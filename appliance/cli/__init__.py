"""`swiftbot …`: parses arguments and prints; the work is done in the rooms.

Commands that do one thing to a fleet are made from the registry (`appliance.operations`); the others are async
functions in the file of their noun. Exit codes are those of `appliance.errors.Exit`. With `--json` an error is JSON as
well, in one line on standard error.
"""

import difflib
import sys

from cyclopts import App, CycloptsError, Parameter, UnknownOptionError
from msgspec import Struct
from rich.markup import escape

from appliance import console, logs
from appliance.cli import (
    alerts,
    backup,
    completion,
    daemons,
    doctor,
    fleet,
    images,
    instructions,
    keys,
    learn,
    llm,
    log,
    manual,
    mcp,
    parts,
    place,
    plan,
    plane,
    plugins,
    pool,
    releases,
    robots,
    rules,
    schedule,
    site,
    stop,
    submit,
    task,
    tui,
)
from appliance.cli.common import add_operations, check_path, json_line
from appliance.errors import ConfigError, Exit, PlanError, SwiftbotError

# No `--no-…` and `--empty-…` beside each option; what is on without being asked for names its own negative.
app = App(
    name="swiftbot",
    help="SwiftBot gateway: instructions to a robot fleet, run in warm containers.",
    version="0.1.0",
    default_parameter=Parameter(
        negative=(), show_default=lambda value: str(value) if value else "", validator=check_path
    ),
)
for noun in (
    submit,
    plan,
    task,
    schedule,
    site,
    instructions,
    parts,
    place,
    rules,
    stop,
    alerts,
    fleet,
    tui,
    llm,
    learn,
    daemons,
    mcp,
    pool,
    robots,
    log,
    plane,
    keys,
    images,
    releases,
    backup,
    doctor,
    completion,
    manual,
):
    noun.add_to(app)
add_operations(app)
plugins.add_to(app)


class ErrorShown(Struct, frozen=True, kw_only=True):
    """What `--json` prints on standard error, under `error`, when a command fails."""

    code: str
    """Kind of error as in docs/schemas/Failure.json; `usage` for a wrong command line or configuration."""
    message: str
    remedy: str
    problems: tuple[str, ...]
    """What is wrong with a plan, one by one."""
    exit_code: int


def main(arguments: list[str] | None = None) -> None:
    """Entry point: run a command and end with its exit code."""
    # Commands speak for themselves; daemons set up their own logging when they start.
    logs.configure(level="warning", style="text")
    words = sys.argv[1:] if arguments is None else arguments
    as_json = "--json" in words
    try:
        _check_text(words)
        code = app(
            words, exit_on_error=False, print_error=not as_json, error_console=console.err, result_action="return_value"
        )
        code = code if isinstance(code, int) else Exit.DONE
    except CycloptsError as error:
        code = Exit.USAGE
        if as_json:
            _tell(ConfigError(str(error), remedy="`--help` shows the options"), as_json=True)
        elif isinstance(error, UnknownOptionError) and (near := _near_option(words)):
            console.err.print(f"  hint: did you mean {near}?")
    except SwiftbotError as error:
        _tell(error, as_json=as_json)
        code = error.exit_code
    except KeyboardInterrupt:
        code = Exit.INTERRUPTED
    sys.exit(code)


def _near_option(words: list[str]) -> str:
    """Return the option of the command that the first unknown one is most like; empty when it is like none."""
    for number, word in enumerate(words):
        if word.startswith("--"):
            known = completion.offers(app, [*words[:number], "--"]).words
            name = word.partition("=")[0]
            if name not in known:
                return next(iter(difflib.get_close_matches(name, known, n=1)), "")
    return ""


def _check_text(words: list[str]) -> None:
    """Raise ConfigError for an argument that is no text: no message, key or record could hold it."""
    for number, word in enumerate(words, start=1):
        if not word.isascii() and any("\ud800" <= each <= "\udfff" for each in word):
            shown = word.encode(errors="replace").decode()[:60]
            raise ConfigError(f"argument {number} is not UTF-8: {shown!r}", remedy="write it in UTF-8")


def _tell(error: SwiftbotError, *, as_json: bool) -> None:
    """Print an error with its remedy on standard error."""
    if as_json:
        told = ErrorShown(
            code="usage" if error.exit_code is Exit.USAGE else error.code,
            message=error.message,
            remedy=error.remedy,
            problems=error.problems if isinstance(error, PlanError) else (),
            exit_code=error.exit_code,
        )
        sys.stderr.write(json_line({"error": told}) + "\n")
        return
    # Messages hold what people and robots wrote: brackets in them are no markup.
    console.err.print(f"[red]error:[/red] {escape(error.message)}", markup=True)
    if error.remedy:
        console.err.print(f"  hint: {error.remedy}", markup=False)
