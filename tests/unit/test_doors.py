"""Rooms that are entered by their doors: what a package's docstring names under "Doors:" is all that others import."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
APPLIANCE = ROOT / "appliance"
ROOMS = ("floor", "llm", "plane", "pool", "record", "robots", "skills", "tasks", "tui")


def doors(room: str) -> set[str]:
    """Return what the docstring names: `module` for all in one, or `module.name`."""
    described = ast.get_docstring(ast.parse((APPLIANCE / room / "__init__.py").read_text())) or ""
    _, _, named = described.partition("Doors:")
    return set(re.findall(r"`([a-z_]+(?:\.\w+)*)`", named.partition("\n\n")[0]))


@cache
def imports() -> tuple[tuple[Path, str, str], ...]:
    """Return who imports what of the product: file, module, name."""
    files = [path for folder in ("appliance", "workshop", "scripts") for path in sorted((ROOT / folder).rglob("*.py"))]
    imported = re.compile(r"^\s*from (appliance\.\S+) import (\([^)]*\)|.*)$", re.MULTILINE)
    return tuple(
        (path, module, name.split(" as ")[0].strip())
        for path in files
        for module, names in imported.findall(path.read_text())
        for name in re.sub("#.*", "", names).strip("()").split(",")
        if name.strip()
    )


def entered(room: str, *, by: Path = ROOT) -> dict[str, list[str]]:
    """Return what files of a folder outside of a room import from within it, `module.name`, and which do."""
    found: dict[str, list[str]] = {}
    for path, module, name in imports():
        outside = path.is_relative_to(by) and not path.is_relative_to(APPLIANCE / room)
        if outside and f"{module}.".startswith(f"appliance.{room}."):
            door = f"{module}.{name}".removeprefix(f"appliance.{room}.")
            found.setdefault(door, []).append(str(path.relative_to(ROOT)))
    return found


def ways_in(name: str) -> set[str]:
    """Return the doors through which a name may be reached: itself, its module, the packages around that."""
    parts = name.split(".")
    return {".".join(parts[:end]) for end in range(1, len(parts) + 1)}


@pytest.mark.parametrize("room", ROOMS)
def test_others_enter_by_the_doors(room: str) -> None:
    """A name inside that another room needs becomes a door, or moves; one that nobody needs is none."""
    open_doors = doors(room)
    past = {name: by for name, by in entered(room, by=APPLIANCE).items() if not open_doors.intersection(ways_in(name))}
    assert not past, f"imported past the doors of appliance.{room}"
    used = {door for name in entered(room) for door in ways_in(name)}
    assert open_doors - used == set(), "nobody enters by these: they are no doors"
