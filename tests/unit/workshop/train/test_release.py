"""The folder of the embedded planner: whole, in the wheel, and closed to training."""

import hashlib
import json
import tomllib
from pathlib import Path

import pytest

from appliance.errors import ConflictError
from appliance.llm.decoder import read_card
from appliance.llm.settings import EMBEDDED_FOLDER
from workshop.train.card import SUMS, outside_release, write_sums


def test_every_file_is_the_one_that_was_released(tmp_path: Path) -> None:
    """Each file has the hash that the list says, none is missing from it, and no model has a tokenizer of its own."""
    listed = dict(line.split("  ")[::-1] for line in (EMBEDDED_FOLDER / SUMS).read_text().splitlines())
    found = {
        str(path.relative_to(EMBEDDED_FOLDER)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in EMBEDDED_FOLDER.rglob("*")
        if path.is_file() and path.name not in {SUMS, "README.md"}
    }
    assert listed == found
    assert sum(name.endswith("tokenizer.json") for name in found) == 1
    card = read_card(EMBEDDED_FOLDER)
    assert card is not None
    assert all(f"{name}/model.onnx" in found for name in card.beside)
    (tmp_path / "a").write_text(json.dumps({}))
    write_sums(tmp_path)
    assert (tmp_path / SUMS).read_text() == f"{hashlib.sha256(b'{}').hexdigest()}  a\n"


def test_the_wheel_has_it_where_an_installed_package_looks(project_root: Path) -> None:
    """The build puts the folder of the tree where `EMBEDDED_FOLDER` points without a tree."""
    build = tomllib.loads((project_root / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    ((source, inside),) = build["force-include"].items()
    assert project_root / source == EMBEDDED_FOLDER
    assert inside == "appliance/data/planner"


def test_training_writes_elsewhere(tmp_path: Path) -> None:
    """Neither the folder nor one within it may be written to unless it is a release."""
    outside_release(tmp_path)
    for folder in (EMBEDDED_FOLDER, EMBEDDED_FOLDER / "second"):
        with pytest.raises(ConflictError, match="comes with the program"):
            outside_release(folder)
