"""What training writes: where that fails, a full disk for one, it is told with cause and remedy."""

import contextlib
import shutil
from collections.abc import Generator, Sequence
from pathlib import Path

from appliance.errors import PrerequisiteError


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
                with contextlib.suppress(OSError):  # the cause is what is told, not what follows from it
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
