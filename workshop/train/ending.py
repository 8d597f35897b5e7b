"""How the training commands end: with what they return, or with an error that names cause and remedy."""

import contextlib
import shutil
import signal
import sys
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, Self

from appliance.errors import Exit, PrerequisiteError, SwiftbotError


@contextlib.contextmanager
def writing(what: str, *, remedy: str, unfinished: Sequence[Path] = ()) -> Generator[None]:
    """Turn a failure to write into an error that names cause and remedy.

    Inside it nothing is done but writing: whatever is raised counts as a failure to write, since the libraries have
    words of their own for a full disk (RuntimeError for a checkpoint, SafetensorError for weights).

    Args:
        what: is written, as the message begins.
        remedy: what to do.
        unfinished: files and folders that are worth nothing half written; removed.

    Raises:
        PrerequisiteError: it could not be written.
    """
    try:
        yield
    except Exception as error:
        for path in unfinished:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):  # the cause is reported, not what follows from it
                    path.unlink(missing_ok=True)
        raise PrerequisiteError(f"{what} cannot be written: {error}", remedy=remedy) from error


def replace_text(path: Path, text: str) -> None:
    """Write a file so that it has either what it had or all of the new text.

    Raises:
        PrerequisiteError: it could not be written.
    """
    new = path.with_name(f"{path.name}.new")
    with writing(f"{path}", remedy="make room and run it again", unfinished=(new,)):
        new.write_text(text, encoding="utf-8")
        new.replace(path)


def ended(main: Callable[[Sequence[str]], int]) -> int:
    """Run a command on the arguments of this process; return what the process ends with."""
    try:
        return main(sys.argv[1:])
    except SwiftbotError as error:
        print(f"error: {error.message}", file=sys.stderr)
        if error.remedy:
            print(f"remedy: {error.remedy}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return Exit.INTERRUPTED


class Stopping:
    """Ctrl+C and SIGTERM while it is entered: once sets `asked`, which the caller polls; twice ends at once."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Take the signals."""
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        """Give them back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, *_: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        print("stops after this step (again: at once)", file=sys.stderr, flush=True)
