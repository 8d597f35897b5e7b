"""The catalogue: equal to the reference, strict, and its handlers need nothing but what their image has."""

import ast
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import ConfigError
from appliance.skills.catalogue import NOT_SKILLS, SKILLS, image_reference, load_catalogue

WITH_HANDLER = {
    "goto", "photograph", "detect", "pick", "place", "record_video", "report", "notify", "takeoff", "land",
    "open", "close", "switch_on", "switch_off", "give", "say", "guide", "dock",
    "extract_frames", "hold", "return_home", "count", "find", "follow_path", "patrol", "plan_route", "orbit", "track",
    "ask", "wait_for", "train_local", "aggregate", "evaluate",
    "encode_clip", "classify_action", "preprocess_audio", "transcribe", "correct_text",
    "clean", "cut", "fasten", "unfasten", "pour", "push", "follow", "localize", "measure", "scan_thermal",
    "record_audio", "map_area", "explore", "split_area", "merge_maps", "compare", "inspect", "match_scene",
    "rendezvous", "form_up",
}  # fmt: skip
MODULES_OF = {"base": set[str](), "vision": {"numpy", "PIL"}}
MODULES_OF["learn"] = MODULES_OF["vision"] | {"torch", "av", "soundfile", "pocketsphinx"}
WITHOUT_COMMANDS = {"train_local"}
"""Run on a robot, as they work on its data, and send it no command."""


@pytest.fixture(scope="module")
def reference(data: Path) -> dict[str, Any]:
    """Return the reference catalogue."""
    return json.loads((data / "catalogue.json").read_text())


def test_it_has_the_reference_skills_exactly(reference: dict[str, Any]) -> None:
    """Ids, domains, parameters, runs, uses, consumes and produces are those of the reference catalogue."""
    catalogue = load_catalogue()
    assert set(catalogue.skills) == {skill["id"] for skill in reference["skills"]}
    assert list(catalogue.domains) == reference["domains"]
    for skill in reference["skills"]:
        manifest = catalogue.skills[skill["id"]]
        assert (manifest.domain, manifest.summary, manifest.runs) == (skill["domain"], skill["summary"], skill["runs"])
        assert (manifest.uses, manifest.consumes, manifest.produces) == (
            tuple(skill["uses"]),
            tuple(skill["consumes"]),
            tuple(skill["produces"]),
        )
        params = {name: {"type": each.type, "required": each.required} for name, each in manifest.params.items()}
        assert params == skill["params"]


def test_a_handler_makes_a_skill_implemented() -> None:
    """`implemented` is true for those skills whose folder has a handler, and for no others."""
    assert {each.id for each in load_catalogue().skills.values() if each.implemented} == WITH_HANDLER


def test_loading_again_is_free() -> None:
    """A second load gives the same object: nothing is read again."""
    assert load_catalogue() is load_catalogue(())


def test_every_robot_skill_that_is_implemented_names_its_verbs() -> None:
    """A skill with handler that runs on a robot says which commands it sends, so that placement can choose."""
    for each in load_catalogue().skills.values():
        commanding = each.implemented and each.runs == "robot" and each.id not in WITHOUT_COMMANDS
        assert bool(each.verbs) == commanding, each.id


def _imports(file: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add((node.module or "").split(".")[0])
    return found


def _shared_modules(file: Path) -> set[Path]:
    """Files of `_lib` that a file needs, over all steps."""
    found: set[Path] = set()
    waiting = [file]
    while waiting:
        at = waiting.pop()
        for node in ast.walk(ast.parse(at.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.level == 1 or (node.module or "").split(".")[0] == "_lib"):
                inside = (node.module or "").split(".")
                folder = at.parent if node.level else SKILLS
                base = folder.joinpath(*(part for part in inside if part))
                for each in [base.with_suffix(".py"), *(base / f"{alias.name}.py" for alias in node.names)]:
                    if each.is_file() and each not in found:
                        found.add(each)
                        waiting.append(each)
    return found


@pytest.mark.parametrize("skill", sorted(WITH_HANDLER))
def test_a_handler_imports_only_what_its_image_has(skill: str) -> None:
    """A handler and the shared modules it needs import the standard library and its image's packages only."""
    allowed = set(sys.stdlib_module_names) | {"_lib"} | MODULES_OF[load_catalogue().skills[skill].image]
    file = SKILLS / skill / "handler.py"
    for each in [file, *_shared_modules(file)]:
        assert _imports(each) <= allowed, each


def test_no_skill_folder_is_a_package() -> None:
    """The skills folder is on handlers' path: a package named like a standard module (`inspect`) would hide it."""
    assert not [each for each in SKILLS.glob("*/__init__.py") if each.parent.name not in NOT_SKILLS]


MANIFEST = """
id = "wave"
domain = "interaction"
summary = "Wave."
runs = "robot"
image = "base"
verbs = ["wave"]
[params.to]
type = "string"
required = false
"""


def _extra(folder: Path, text: str, *, name: str = "wave") -> Path:
    root = folder / "more"
    (root / name).mkdir(parents=True, exist_ok=True)
    (root / name / "skill.toml").write_text(text)
    return root


def test_an_extra_folder_adds_a_skill(tmp_path: Path) -> None:
    """A folder beside the built-in ones adds its skills; one without handler is known and not implemented."""
    catalogue = load_catalogue([_extra(tmp_path, MANIFEST)])
    assert catalogue.skills["wave"].verbs == ("wave",)
    assert not catalogue.skills["wave"].implemented
    assert "goto" in catalogue.skills


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('runs = "robot"', 'runs = "robot"\nspeed = 3', "speed: unknown key"),
        ('runs = "robot"', 'runs = "moon"', "runs: "),
        ('runs = "robot"', "", "runs: missing"),
        ('runs = "robot"', 'runs = "robot"\ncpu = "much"', "cpu: "),
        ('runs = "robot"', 'runs = "robot"\ncpu = 0', "cpu: "),
        ('runs = "robot"', 'runs = "robot"\nmemory_mb = 1.5', "memory_mb: "),
        ('runs = "robot"', 'runs = "robot"\nretries = -1', "retries: "),
        ('runs = "robot"', 'runs = "robot"\nloads = ["a.json"]', "preload_mb: needed with `loads`"),
        ('runs = "robot"', 'runs = "robot"\npreload_mb = 1\nloads = ["a.json"]', "loads: "),
        ('runs = "robot"', 'runs = "robot"\npreload_mb = 1\nloads = ["maps:a"]', "loads: 'maps:a': 'maps' is none"),
        ('runs = "robot"', 'runs = "robot"\npreload_mb = 1\nloads = ["../a"]', "loads: '../a': the path"),
        ('runs = "robot"', 'runs = "robot"\nfile_mb = 0', "file_mb: "),
        ('runs = "robot"', 'runs = "robot"\nimplemented = true', "implemented: unknown key"),
        ('runs = "robot"', 'runs = "robot"\nfolder = "/tmp"', "folder: unknown key"),
        ('runs = "robot"', 'runs = "compute"', "verbs: "),
        ('domain = "interaction"', 'domain = "cooking"', "domain: "),
        ('id = "wave"', 'id = "waves"', "id: "),
        ('id = "wave"', "id = 3", "id: "),
        ('image = "base"', 'image = "gpu"', "image: there is no image 'gpu'"),
        ('type = "string"', 'type = "colour"', "params.to.type: "),
        ("required = false", 'required = "no"', "params.to.required: "),
        ("[params.to]", "[params.To]", "params.To: "),
        ("[params.to]", "[params.to", "cannot be read"),
        ("[params.to]", '[results.count]\ntype = "many"\n[params.to]', "results.count.type: "),
        ("[params.to]", "[results.count]\nrequired = true\n[params.to]", "results.count.type: missing"),
        ("[params.to]", '[results.Count]\ntype = "number"\n[params.to]', "results.Count: "),
    ],
)
def test_a_wrong_manifest_names_file_and_key(tmp_path: Path, old: str, new: str, key: str) -> None:
    """Whatever is wrong in a manifest is a ConfigError with the file and the key, and says what to do."""
    root = _extra(tmp_path, MANIFEST.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_catalogue([root])
    assert str(root / "wave" / "skill.toml") in caught.value.message
    assert key in caught.value.message
    assert caught.value.remedy


def test_an_id_may_be_there_once(tmp_path: Path) -> None:
    """A skill that another folder has already is refused, with both folders named."""
    text = MANIFEST.replace('id = "wave"', 'id = "goto"')
    with pytest.raises(ConfigError, match=r"goto/skill\.toml: id: skill 'goto' is in .*skills/goto too"):
        load_catalogue([_extra(tmp_path, text, name="goto")])


def test_a_folder_without_manifest_is_refused(tmp_path: Path) -> None:
    """A skill folder whose skill.toml is missing is an error, not a skill that silently is not there."""
    (tmp_path / "wave").mkdir()
    with pytest.raises(ConfigError, match=r"wave: skill\.toml is missing"):
        load_catalogue([tmp_path])


def test_a_missing_extra_folder_is_refused(tmp_path: Path) -> None:
    """A configured folder that does not exist is an error."""
    with pytest.raises(ConfigError, match="no such folder"):
        load_catalogue([tmp_path / "nowhere"])


def test_images_may_be_added_and_must_be_whole(tmp_path: Path) -> None:
    """An extra folder may bring images; one compatible with an image that is not there is refused."""
    image = tmp_path / "images" / "speech"
    image.mkdir(parents=True)
    (image / "image.toml").write_text('name = "speech"\npackages = ["python3", "espeak-ng"]\ncompatible = ["base"]\n')
    spec = load_catalogue([tmp_path]).images["speech"]
    assert spec.packages == ("python3", "espeak-ng")
    assert image_reference("speech", folder=spec.folder).startswith("localhost/swiftbot/speech:")
    other = shutil.copytree(tmp_path, tmp_path.parent / f"{tmp_path.name}-2")
    (other / "images" / "speech" / "image.toml").write_text(
        'name = "speech"\npackages = ["python3"]\ncompatible = ["gpu"]\n'
    )
    with pytest.raises(ConfigError, match="compatible: there is no image 'gpu'"):
        load_catalogue([other])


def test_an_image_s_tag_follows_its_content(tmp_path: Path) -> None:
    """The same files give the same tag, a changed one another; an unknown image is a ConfigError."""
    image = tmp_path / "speech"
    image.mkdir()
    (image / "image.toml").write_text("one")
    first = image_reference("speech", folder=image)
    assert first == image_reference("speech", folder=image)
    assert len(first.rpartition(":")[2]) == 12
    (image / "image.toml").write_text("two")
    assert image_reference("speech", folder=image) != first
    with pytest.raises(ConfigError, match="no image 'gpu'"):
        image_reference("gpu")
