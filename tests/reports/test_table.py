"""The table of public reports is whole: each has a test that says so, and each test of a report is in it."""

import ast
import re
import tomllib
from collections import Counter
from pathlib import Path

import pytest

SOURCE = re.compile(r"[A-Za-z0-9][A-Za-z0-9-]*/[A-Za-z0-9._-]+#[1-9][0-9]*")
FIELDS = {"source", "title", "fault", "input", "right", "test"}
MODULES = (
    "tests/integration/robots/test_reports.py",
    "tests/unit/pool/test_reported_runs.py",
    "tests/unit/record/test_reported_logs.py",
    "tests/unit/robots/test_reported_commands.py",
    "tests/unit/robots/test_reported_streams.py",
    "tests/unit/tasks/test_reported_tasks.py",
)


@pytest.fixture(scope="module")
def reports(project_root: Path) -> list[dict[str, str]]:
    """Return the rows."""
    with (project_root / "tests/reports/reports.toml").open("rb") as file:
        return tomllib.load(file)["report"]


def tried(path: Path) -> dict[str, set[str]]:
    """Return each test of a module with the sources that it names: in its docstring, or as its parameters."""
    tree = ast.parse(path.read_text())
    tables = {
        node.target.id: node.value.keys
        for node in tree.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and isinstance(node.value, ast.Dict)
    }
    found: dict[str, set[str]] = {}
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or not node.name.startswith("test_"):
            continue
        named = set(SOURCE.findall(ast.get_docstring(node) or ""))
        for part in (part for decorator in node.decorator_list for part in ast.walk(decorator)):
            keys = tables.get(part.id, []) if isinstance(part, ast.Name) else [part]
            named |= {
                key.value
                for key in keys
                if isinstance(key, ast.Constant) and isinstance(key.value, str) and SOURCE.fullmatch(key.value)
            }
        found[f"{path.name}::{node.name}"] = named
    return found


def test_each_report_is_well_formed_and_there_once(reports: list[dict[str, str]]) -> None:
    """At least sixty, all fields filled in, no source twice."""
    assert len(reports) >= 60
    for row in reports:
        assert set(row) == FIELDS, row
        assert all(value.strip() == value and value for value in row.values()), row
        assert SOURCE.fullmatch(row["source"]), row["source"]
    assert not [source for source, count in Counter(row["source"] for row in reports).items() if count > 1]


def test_each_report_has_a_test_and_each_test_a_report(reports: list[dict[str, str]], project_root: Path) -> None:
    """The test that a row names is there and names the row's source, and no test names a source without a row."""
    rows = {(row["source"], row["test"]) for row in reports}
    tests = {
        (source, f"{Path(module).parent.as_posix()}/{test}")
        for module in MODULES
        for test, sources in tried(project_root / module).items()
        for source in sources
    }
    assert rows == tests


def test_each_test_of_a_report_names_one(project_root: Path) -> None:
    """In the modules that are nothing but reports."""
    silent = [test for module in MODULES for test, sources in tried(project_root / module).items() if not sources]
    assert silent == []


def test_every_surface_is_tried(reports: list[dict[str, str]]) -> None:
    """Of each area so many at least, and so many of all by a real process."""
    by = Counter(row["test"].split("::")[0] for row in reports)
    process = by["tests/integration/robots/test_reports.py"]
    zenoh = sum("zenoh" in row["source"] for row in reports)
    assert process >= 20
    assert zenoh >= 8
    assert by["tests/unit/robots/test_reported_streams.py"] + process - zenoh >= 25
    assert by["tests/unit/robots/test_reported_commands.py"] >= 12
    assert by["tests/unit/pool/test_reported_runs.py"] + by["tests/unit/tasks/test_reported_tasks.py"] >= 10
    assert by["tests/unit/record/test_reported_logs.py"] >= 10
