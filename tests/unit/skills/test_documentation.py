"""docs/skills.md does what it says: its example works, and its tables name every key and every skill that runs."""

import re
import shutil
import textwrap
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from appliance.skills.catalogue import ImageSpec, SkillManifest, load_catalogue

SET_BY_LOADER = {"implemented", "folder"}


@pytest.fixture(scope="module")
def text(project_root: Path) -> str:
    """Return the document."""
    return (project_root / "docs" / "skills.md").read_text()


def test_the_walk_through_works(
    tmp_path: Path, project_root: Path, make_ctx: Callable[..., Any], handler: Callable[..., ModuleType]
) -> None:
    """The example's folder, copied to a folder of one's own, is a skill of the catalogue whose handler runs."""
    mine = tmp_path / "skills"
    shutil.copytree(project_root / "docs" / "examples" / "skills", mine)
    skill = load_catalogue([mine]).skills["battery_check"]
    assert skill.implemented
    assert skill.folder == mine / "battery_check"
    run = handler("battery_check", skill.folder).run
    ctx = make_ctx(at_least=30)
    ctx.info["battery_percent"] = 55.5
    assert run(ctx)["number"] == 55.5
    assert ctx.steps[-1] == (1.0, "55.5 %")
    ctx.info["battery_percent"] = 12
    with pytest.raises(ctx.Fail, match="has 12 %, 30 % are wanted"):
        run(ctx)


def test_the_text_shows_the_example_as_it_is(text: str, project_root: Path) -> None:
    """The document's listings are the example's files, word for word."""
    folder = project_root / "docs" / "examples" / "skills" / "battery_check"
    for language, name in (("toml", "skill.toml"), ("python", "handler.py")):
        listing = re.search(rf"   ```{language}\n(.*?)   ```", text, re.DOTALL)
        assert listing is not None
        assert textwrap.dedent(listing.group(1)) == (folder / name).read_text()


def _keys(text: str, heading: str) -> set[str]:
    """Names in the first column of the first table under a heading."""
    section = text.split(f"\n## {heading}\n")[1].partition("\n## ")[0]
    table = re.search(r"(?:^\|.*\n)+", section, re.MULTILINE)
    assert table is not None
    return {name for row in table.group(0).splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[1])}


def test_the_tables_are_complete(text: str) -> None:
    """Every key of a manifest and of an image is in its table, and every skill that runs is listed."""
    assert _keys(text, "The manifest") == set(SkillManifest.__struct_fields__) - SET_BY_LOADER
    assert _keys(text, "Images") == set(ImageSpec.__struct_fields__) - SET_BY_LOADER
    assert _keys(text, "Skills that run") == {each.id for each in load_catalogue().skills.values() if each.implemented}


def test_the_images_are_described_as_they_are(text: str) -> None:
    """The list of images names each with its packages."""
    for name, spec in load_catalogue().images.items():
        assert f"| `{name}` | {', '.join(spec.packages)} |" in text
