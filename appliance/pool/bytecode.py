"""Adds bytecode to folders that containers mount or are made of.

Containers cannot write any: without it each would compile all that it imports, at each start.
"""

import py_compile
import sys
from pathlib import Path


def add_bytecode(tree: Path, *, inside: Path | None = None) -> None:
    """Compile all modules below a folder with this Python; another version's ignores what is written.

    It is used only while it is of the very source beside it, whose hash it holds. A module that does not compile is
    left alone: whoever imports it is told what is wrong with it.

    Args:
        tree: the folder.
        inside: where the folder will be, for tracebacks; None: where it is.
    """
    for file in tree.rglob("*.py"):
        # Spelled out, since a prefix for bytecode in this process's environment is of no use to a container.
        compiled = file.parent / "__pycache__" / f"{file.stem}.{sys.implementation.cache_tag}.pyc"
        shown = str(inside / file.relative_to(tree)) if inside else None
        try:
            py_compile.compile(
                str(file),
                str(compiled),
                shown,
                doraise=True,
                invalidation_mode=py_compile.PycInvalidationMode.CHECKED_HASH,
            )
        except py_compile.PyCompileError:
            continue
