"""What this container is to serve: the file that the gateway wrote before it started it.

A file and not an argument, because a site's map has no bound that an argument list would have.
"""

import json
from pathlib import Path
from typing import Any, cast

Table = dict[str, Any]


class Skill:
    """One skill: where its handler is, what it loads beforehand, what bounds it has."""

    def __init__(self, name: str, table: Table) -> None:
        self.name = name
        self.folder = Path(str(table["folder"]))
        self.loads = tuple(str(each) for each in table.get("loads") or ())
        """Files that its `preload` reads; one that is missing is reported before it is called."""
        self.preload_mb = int(table.get("preload_mb", 0))
        """Memory that its `preload` may take; 0: it has none."""
        self.preload_s = float(table.get("preload_s", 10.0))
        self.file_mb = int(table.get("file_mb", 256))
        """Longest file that its runs may write."""


class Spec:
    """All that a zygote reads at its start."""

    def __init__(self, table: Table) -> None:
        skills = cast("dict[str, Table]", table.get("skills") or {})
        self.skills = {name: Skill(name, each) for name, each in skills.items()}
        roots = cast("dict[str, str]", table.get("roots") or {})
        self.roots = {name: Path(str(path)) for name, path in roots.items()}
        """Folders that code is loaded from, by the name that the gateway knows each by."""
        self.modules = tuple(str(each) for each in table.get("modules") or ())
        self.site = cast("Table", table.get("site") or {})
        self.volumes = Path(str(table.get("volumes") or "/volumes"))
        self.folders = Path(str(table.get("folders") or "/folders"))
        """Where the folders of the gateway's machine are mounted."""
        self.cache = Path(str(table["cache"])) if table.get("cache") else None
        """Where runs keep what they can work out again; None: nowhere."""
        self.reserve_mb = int(table.get("reserve_mb", 0))
        """What is to be left free on the disk of the volumes, MB; 0: it is not watched."""
        self.max_result_bytes = int(table.get("max_result_bytes", 4 * 2**20))
        """Longest result in bytes of JSON; larger things are artifacts."""
        self.import_s = float(table.get("import_s", 10.0))
        """Longest import of one module or handler."""
        self.patience_s = float(table.get("patience_s", 15.0))
        """Time for everything that is loaded beforehand, together."""
        self.proven = bool(table.get("proven", False))
        """Whether a container made just so came up without a problem, so that nothing need be tried first."""

    @classmethod
    def read(cls, path: Path) -> "Spec":
        """Read it; OSError or ValueError where it cannot be."""
        return cls(json.loads(path.read_text(encoding="utf-8")))
