"""The shape of `ctx`, so that handlers are checked by type; the object itself comes from the runner."""

import mmap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol


class Surroundings(Protocol):
    """What a handler's `preload(ctx)` gets; docs/skills.md explains each member."""

    site: dict[str, Any]
    folder: Path

    def volume(self, name: str) -> Path:
        """Return the folder of a named volume; raises Fail when it is not mounted."""
        ...

    def host_folder(self, name: str) -> Path:
        """Return a folder of the gateway's machine; raises Fail when it is not mounted."""
        ...

    def map(self, path: str | Path) -> mmap.mmap:
        """Return a file's bytes without reading them."""
        ...

    def Fail(self, message: str, remedy: str = "", retryable: bool = False) -> Exception:  # noqa: N802 - a class
        """Make the exception that ends the run with that reason."""
        ...


class Context(Surroundings, Protocol):
    """What a handler's `run(ctx)` gets."""

    params: dict[str, Any]
    robot: str | None
    robots: tuple[str, ...]
    inputs: dict[str, dict[str, Any]]
    attempt: int
    resume: dict[str, Any] | None
    preloaded: Any
    scratch: Path
    cache: Path

    def CallError(self, code: str, message: str, remedy: str = "", retryable: bool = False) -> Exception:  # noqa: N802
        """Make the exception that ends the run with that reason and an error's code, which says whose fault it is."""
        ...

    def command(self, verb: str, timeout_s: float = 60, **args: Any) -> dict[str, Any]:
        """Have the robot do `verb`; files of the answer are bytes in `answer["blobs"][name]`."""
        ...

    def command_all(
        self, verb: str, robots: dict[str, dict[str, Any]], timeout_s: float = 60
    ) -> dict[str, dict[str, Any]]:
        """Have several of its robots do `verb` at the same time; all of them, or none any longer."""
        ...

    def notify(self, to: str, text: str) -> dict[str, Any]:
        """Send a message to a person."""
        ...

    def ask(self, question: str, choices: Sequence[str] = (), to: str = "operator", timeout_s: float = 240) -> str:
        """Ask people and return the answer, one of `choices` where there are any."""
        ...

    def request(self, name: str, **args: Any) -> dict[str, Any]:
        """Ask a part of the gateway that offers something to skills that come with it."""
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

    def alive(self) -> None:
        """Give a sign of life and nothing more."""
        ...

    def partial(self, result: dict[str, Any]) -> None:
        """Publish what is known so far."""
        ...

    def checkpoint(self, data: dict[str, Any]) -> None:
        """Keep data from which a later attempt could go on."""
        ...

    def checkpoint_due(self) -> bool:
        """Whether the appliance wants a checkpoint now, since the run is about to be moved."""
        ...
