"""Folders in which benchmarks keep a fleet's files and logs: gone afterwards, unless something went wrong."""

import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def workspace(prefix: str = "swiftbot-bench-") -> Generator[Path]:
    """A new folder; it stays where it is when an error ends the benchmark, whose remedy names the logs in it."""
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    try:
        yield folder
    except Exception:  # the folder stays: the error names the logs in it
        raise
    except BaseException:  # given up by whoever started it
        shutil.rmtree(folder, ignore_errors=True)
        raise
    else:
        shutil.rmtree(folder, ignore_errors=True)
