"""The project needs nothing from outside its own folder: no file names a folder beside it, and all data is here."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

from workshop.bench.plan import default_cases

BESIDE = re.compile(rb"[.]{2}/shared|SWIFTBOT_[S]HARED|reference data not [f]ound")
"""What named a folder of data beside the project. In brackets, so that it does not find itself."""
MADE = {"__pycache__", "build", "dist"}
"""Folders that are no part of the project, beside the hidden ones."""


def files(root: Path) -> Iterator[Path]:
    """Yield the project's files; whether they are tracked is not asked, since the tests' copy is no checkout."""
    for folder, below, names in os.walk(root):
        below[:] = [each for each in below if each == ".ci" or (each not in MADE and not each.startswith("."))]
        yield from (Path(folder, name) for name in names if name != ".git")


def test_no_file_names_a_folder_beside_the_project(project_root: Path) -> None:
    """Neither scripts, tests, documents nor the program look for data there."""
    found = list(files(project_root))
    assert {project_root / each for each in (".ci/run", "Makefile", "tests/conftest.py")} <= set(found)
    assert [str(each.relative_to(project_root)) for each in found if BESIDE.search(each.read_bytes())] == []


def test_the_development_cases_are_in_the_package(project_root: Path) -> None:
    """The default of `swiftbot bench plan`, with its scorer: an installed package has them too."""
    cases = default_cases()
    assert cases.is_relative_to(project_root / "workshop")
    assert cases.is_file()
    assert cases.with_name("score.py").is_file()


def test_each_data_file_has_a_source_and_a_licence(data: Path) -> None:
    """The README beside them has a line for each."""
    told = (data / "README.md").read_text()
    names = {str(each.relative_to(data)) for each in data.rglob("*") if each.is_file()}
    assert sorted(name for name in names - {"README.md"} if f"`{name}`" not in told) == []
