"""How the training commands end: with what they return, or with an error that names cause and remedy."""

import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any, Self

from appliance.errors import Exit, SwiftbotError


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
    """Ctrl+C and SIGTERM while it is entered: asked for once, it is for whoever looks at `asked`; twice, at once."""

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
