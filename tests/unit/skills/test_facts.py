"""Facts about skills: consistent in the built-in manifests, strict, and enough for a skill of a folder of one's own."""

from pathlib import Path

import pytest

from appliance.errors import ConfigError
from appliance.llm import language
from appliance.llm.checks.facts import claims
from appliance.llm.checks.reading import read as read_words
from appliance.llm.rules.grammar import Step
from appliance.llm.rules.graph import Graph
from appliance.llm.rules.tier import domain_of
from appliance.llm.words import words_of
from appliance.model import Subtask
from appliance.skills.catalogue import SkillManifest, load_catalogue

SKILLS = load_catalogue().skills

CLAMP = """
id = "clamp"
domain = "coordination"
summary = "Take hold of something together with other robots."
runs = "robot"
uses = ["base", "arm"]
image = "base"
ties = ["load"]
opposite_of = ["unfasten"]
moves_robot = true
joint = true
at_object = "object"
phrases = ["clamp", "take between you"]
[params.robots]
type = "array"
required = true
[params.object]
type = "string"
required = true
"""

HUM = """
id = "hum"
domain = "interaction"
summary = "Give a low sound, so that people hear the robot come."
runs = "robot"
uses = ["speaker"]
image = "base"
reports = true
incidental = true
phrases = ["hum"]
"""

UNCLAMP = """
id = "unclamp"
domain = "manipulation"
summary = "Let go of what is clamped."
runs = "robot"
uses = ["arm"]
image = "base"
frees = ["load"]
phrases = ["unclamp"]
[params.object]
type = "string"
required = true
"""


def folder(where: Path, *manifests: str) -> Path:
    """Write a folder of skills without handlers."""
    for text in manifests:
        name = text.split('"')[1]
        (where / name).mkdir(parents=True)
        (where / name / "skill.toml").write_text(text)
    return where


@pytest.mark.parametrize("manifest", SKILLS.values(), ids=SKILLS)
def test_each_built_in_skill_has_its_phrases(manifest: SkillManifest) -> None:
    """People have several ways to ask for anything, each of which is there once."""
    assert len(manifest.phrases) >= 5
    assert len(set(manifest.phrases)) == len(manifest.phrases)


@pytest.mark.parametrize("manifest", SKILLS.values(), ids=SKILLS)
def test_the_facts_of_a_skill_agree(manifest: SkillManifest) -> None:
    """What a manifest says of opposites, states, actuators and parameters fits together."""
    for other in manifest.opposite_of:
        assert manifest.id in SKILLS[other].opposite_of
        assert set(manifest.opposite_of).isdisjoint(SKILLS[other].opposite_of)
    if "load" in manifest.ties:
        assert {other for other in SKILLS if "load" in SKILLS[other].frees} == set(manifest.opposite_of)
    if {"position", "flight"} & {*manifest.prepares, *manifest.frees}:
        assert manifest.moves_robot
    assert manifest.flying == (
        "flight" in (*manifest.prepares, *manifest.frees) and "position" not in manifest.prepares
    )
    robots = manifest.params.get("robots")
    assert manifest.joint == (robots is not None and robots.required)
    if manifest.reports:
        assert set(manifest.uses) <= {"speaker"}
        assert not manifest.danger
    if manifest.at_object:
        assert "arm" in manifest.uses
        assert manifest.params[manifest.at_object].required


def test_only_holding_uses_the_base_without_moving_it() -> None:
    """A skill that occupies the base moves the robot, but for the one that keeps it where it is."""
    assert {each.id for each in SKILLS.values() if "base" in each.uses and not each.moves_robot} == {"hold"}


def test_an_order_that_works_on_others_comes_after_them_by_its_data_too() -> None:
    """A skill feeds on such as are no skill of its own kind, and consumes something."""
    for each in SKILLS.values():
        assert each.id not in each.feeds_on
        assert not each.feeds_on or each.consumes


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('["unfasten"]', '["unfasten", "glue"]', "opposite_of: 'glue' is no other skill"),
        ('["unfasten"]', '["clamp"]', "opposite_of: 'clamp' is no other skill"),
        ('["unfasten"]', '["unclamp"]', "opposite_of: 'unclamp' does not name 'clamp'"),
        ('["base", "arm"]', '["arm"]', "moves_robot: "),
        ('"robot"\nuses', '"compute"\nflying = true\nuses', "flying: "),
        ("joint = true", "reports = true", "reports: "),
        ('at_object = "object"', 'at_object = "thing"', "at_object: 'thing' is none"),
        ('at_object = "object"', 'at_object = "robots"', "at_object: 'robots' is none"),
        ('type = "array"\nrequired = true', 'type = "array"\nrequired = false', "joint: "),
        ('"clamp", "take', '"Clamp", "take', "phrases: 'Clamp'"),
        ('"clamp", "take', '" clamp", "take', "phrases: ' clamp'"),
        ('"clamp", "take', '"", "take', "phrases[0]: "),
        ("joint = true", 'joint = "yes"', "joint: "),
        ("joint = true", 'joint = true\nfeeds_on = ["nothing"]', "feeds_on: 'nothing' is no other skill"),
    ],
)
def test_a_wrong_fact_names_file_and_key(tmp_path: Path, old: str, new: str, key: str) -> None:
    """A fact that cannot be is a ConfigError with the file and the key, when the catalogue is loaded."""
    assert old in CLAMP
    root = folder(tmp_path / "more", CLAMP.replace(old, new), UNCLAMP)
    with pytest.raises(ConfigError) as caught:
        load_catalogue([root])
    assert str(root / "clamp" / "skill.toml") in caught.value.message
    assert key in caught.value.message
    assert caught.value.remedy


def test_a_built_in_skill_learns_its_opposite_from_another_folder(tmp_path: Path) -> None:
    """A skill of a site names a built-in one as its opposite, and no built-in file has to be edited for it."""
    skills = load_catalogue([folder(tmp_path / "more", CLAMP)]).skills
    assert skills["clamp"].opposite_of == ("unfasten",)
    assert skills["unfasten"].opposite_of == ("fasten", "clamp")
    assert SKILLS["unfasten"].opposite_of == ("fasten",)


def test_words_ask_for_a_skill_of_another_folder(tmp_path: Path) -> None:
    """Its phrases are found in instructions as those of built-in skills are, endings of verbs included."""
    catalogue = load_catalogue([folder(tmp_path / "more", CLAMP, HUM)])
    found = claims(read_words("rover_1 hums, then goes to dock 1", None), catalogue)
    assert "hum" in found[0][0].skills
    assert any("goto" in each.skills for options in found for each in options)


def test_a_joint_skill_of_another_folder_is_written_by_its_robots(tmp_path: Path) -> None:
    """The planner's language says the robots of a joint skill and not its robot, which is the first of them."""
    catalogue = load_catalogue([folder(tmp_path / "more", CLAMP)])
    params = {"robots": ["rover_1", "rover_2"], "object": "pipe"}
    answer = language.Answer(
        domain="coordination", subtasks=(Subtask(id="s1", skill="clamp", robot="rover_1", params=params),)
    )
    words = words_of("rover_1 and rover_2 clamp the pipe")
    symbols = language.write(answer, words, catalogue)
    assert symbols[:3] == ["coordination", "clamp", "robots:"]
    assert language.read(symbols, words, catalogue) == answer


def test_an_incidental_skill_of_another_folder_is_not_what_a_plan_is_about(tmp_path: Path) -> None:
    """A plan's domain is that of its main purpose, also beside skills of a site that serve it."""
    catalogue = load_catalogue([folder(tmp_path / "more", HUM)])
    hums = [Subtask(id=f"s{number}", skill="hum", robot="rover_1") for number in (1, 2)]
    cut = Subtask(id="s3", skill="cut", robot="rover_1", params={"object": "rope"})
    assert domain_of([*hums, cut], catalogue) == "manipulation"
    assert domain_of(hums, catalogue) == "interaction"


def test_the_rules_know_what_a_skill_of_another_folder_holds(tmp_path: Path) -> None:
    """What it has taken is held until a skill that frees the load, and all of its robots wait for each other."""
    catalogue = load_catalogue([folder(tmp_path / "more", CLAMP, UNCLAMP)])
    graph = Graph(catalogue)
    graph.add(["rover_1"], [Step("clamp", {"robots": ["rover_1", "rover_2"], "object": "pipe"})])
    assert graph.held["rover_1"] == {"pipe"}
    graph.add(["rover_1"], [Step("unclamp", {"object": "pipe"})])
    assert not graph.held["rover_1"]
    graph.add(["rover_2"], [Step("cut", {"object": "rope"})], list_item=False)
    assert [(each.skill, each.robot, each.after) for each in graph.subtasks()] == [
        ("clamp", "rover_1", ()),
        ("unclamp", "rover_1", ("s1",)),
        ("cut", "rover_2", ("s1",)),
    ]
