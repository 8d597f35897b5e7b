"""The shape of `ctx`, so that handlers are checked by type; the object itself comes from the runner."""

from pathlib import Path
from typing import Any, Protocol


class Context(Protocol):
    """What a handler's `run(ctx)` gets; docs/skills.md explains each member."""

    params: dict[str, Any]
    robot: str | None
    inputs: dict[str, dict[str, Any]]
    attempt: int
    site: dict[str, Any]
    scratch: Path

    def Fail(self, message: str, remedy: str = "", retryable: bool = False) -> Exception:  # noqa: N802 - a class
        """Make the exception that ends the run with that reason."""
        ...

    def command(self, verb: str, timeout_s: float = 60, **args: Any) -> dict[str, Any]:
        """Have the robot do `verb`; files of the answer are bytes in `answer["blobs"][name]`."""
        ...

    def notify(self, to: str, text: str) -> dict[str, Any]:
        """Send a message to a person."""
        ...

    def put_artifact(self, name: str, data: bytes, media_type: str = ...) -> dict[str, Any]:
        """Keep a file, return a reference to it."""
        ...

    def get_artifact(self, ref: dict[str, Any]) -> bytes:
        """Return the bytes behind a reference."""
        ...

    def progress(self, fraction: float, note: str = "") -> None:
        """Tell how far it is, 0 to 1, and what it does."""
        ...

    def log(self, text: str, **fields: Any) -> None:
        """Write a line to the fleet's log."""
        ...

    def partial(self, result: dict[str, Any]) -> None:
        """Publish what is known so far."""
        ...

    def checkpoint(self, data: dict[str, Any]) -> None:
        """Keep data from which a later attempt could go on."""
        ...
