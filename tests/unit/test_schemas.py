"""The JSON schemas in docs/schemas are those of the structs as they are."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import msgspec
import pytest

from appliance.model import Plan, Subtask


@pytest.fixture
def export(project_root: Path) -> ModuleType:
    """Return the export script as a module."""
    spec = importlib.util.spec_from_file_location("export_schemas", project_root / "scripts" / "export_schemas.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_committed_schemas_are_up_to_date(export: ModuleType, project_root: Path) -> None:
    """Every public struct has its schema file, no file is left over; `python scripts/export_schemas.py` mends it."""
    folder = project_root / "docs" / "schemas"
    assert {file.name: file.read_text() for file in folder.glob("*.json")} == export.schemas()


def test_schemas_of_what_commands_print_are_up_to_date(export: ModuleType, project_root: Path) -> None:
    """Each command of the table is one, and has its schema file."""
    folder = project_root / "docs" / "schemas" / "commands"
    assert {file.name: file.read_text() for file in folder.glob("*.json")} == export.printed()


def test_a_schema_tells_what_a_struct_takes(export: ModuleType) -> None:
    """The plan's schema names its subtasks' fields and tiers, and an encoded plan has no others."""
    schema = json.loads(export.schemas()["Plan.json"])
    body = schema["$defs"]["Plan"]["properties"]
    plan = msgspec.to_builtins(Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="goto"),), confidence=0.5))
    assert set(plan) <= set(body)
    assert set(schema["$defs"]["Subtask"]["required"]) == {"id", "skill"}
