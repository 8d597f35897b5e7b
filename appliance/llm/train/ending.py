"""How the training commands end: with what they return, or with an error that names cause and remedy."""

import sys
from collections.abc import Callable, Sequence

from appliance.errors import SwiftbotError

INTERRUPTED = 130


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
        return INTERRUPTED
