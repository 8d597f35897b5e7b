"""Sites: the demo's map is whole, and a wrong map is refused with the key that is wrong."""

from pathlib import Path

import pytest

from appliance.errors import ConfigError
from appliance.skills.sites import SITES, differs, load_site


def test_a_file_that_is_not_what_was_loaded_is_told(tmp_path: Path) -> None:
    """Changed, broken or gone it is told, with the cause; mended it is not told any more."""
    file = tmp_path / "yard.toml"
    good = SITES.joinpath("warehouse.toml").read_text(encoding="utf-8")
    file.write_text(good)
    site = load_site(file)
    assert differs(file, site) == ""
    file.write_text(good + "\n[places.far]\nx = 1.5\ny = 1.5\n")
    assert differs(file, site) == "the site's file has changed: the site from before is used until a restart"
    file.write_text(good + "\n[places.far]\nx = \n")
    assert "cannot be loaded any more" in differs(file, site)
    assert "yard.toml" in differs(file, site)
    file.unlink()
    assert "there is no site" in differs(file, site)
    file.write_text(good)
    assert differs(file, site) == ""


def test_the_warehouse_has_what_the_demo_names() -> None:
    """Places, aliases and objects of the demo's site are there, articles and case aside."""
    site = load_site("warehouse")
    for name in ("dock 1", "dock 2", "Dock 3", "dock 4", "the aisle", "shelf", "goal 1", "goal 2", "charger", "home",
                 "the inspection point", "helipad", "loading dock 3"):  # fmt: skip
        assert site.find(name) is not None, name
    at = {each.name: each.at for each in site.objects}
    assert (at["red box"], at["blue box"]) == ("dock 3", "dock 1")
    assert site.forbidden
    assert site.obstacles


SITE = """
name = "yard"
[places.home]
x = 1
y = 2
aliases = ["base"]
[places."gate 1"]
x = 9
y = 9
[[obstacles]]
name = "rack"
x = [3, 5]
y = [3, 5]
[[objects]]
name = "red box"
colour = "red"
at = "gate 1"
"""


AISLE = """[[aisles]]
name = "lane"
x = [5, 8]
y = [3, 5]
"""


def test_a_file_of_one_s_own_is_read(tmp_path: Path) -> None:
    """A path gives the site of that file."""
    (tmp_path / "yard.toml").write_text(SITE)
    assert load_site(tmp_path / "yard.toml").places["gate 1"].x == 9.0


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('name = "yard"', 'name = "yard"\nwidth = 3', "width: unknown key"),
        ("x = 1", "x = 1\nheight = 3", "places.home.height: unknown key"),
        ("x = 1", 'x = "one"', "places.home.x: "),
        ("x = 1", "x = nan", "places.home.x: "),
        ("x = 1", "x = 1\nz = 900", "places.home.z: "),
        ('aliases = ["base"]', 'aliases = ["The Base"]', "places.home.aliases: "),
        ('aliases = ["base"]', 'aliases = ["gate 1"]', "places.gate 1: 'gate 1' means 'home' too"),
        ("[places.home]", "[places.Home]", "places.Home: "),
        ("x = [3, 5]", "x = [5, 3]", "obstacles[0].x: "),
        ("x = [3, 5]", "x = [3, 5, 7]", "obstacles[0].x: "),
        ("x = [3, 5]", "x = [0, 5]\nz = [0, 5]", "obstacles[0].z: unknown key"),
        ("x = [3, 5]\ny = [3, 5]", "x = [0, 5]\ny = [0, 5]", "places.home: lies inside 'rack'"),
        ("[[objects]]", f"{AISLE}[[objects]]", "aisles[0].one_way: "),
        ("[[objects]]", f'{AISLE}one_way = "up"\n[[objects]]', "aisles[0].one_way: "),
        ("[[objects]]", f'{AISLE}one_way = "east"\nspeed = 1\n[[objects]]', "aisles[0].speed: unknown key"),
        ("[[objects]]", f'{AISLE}one_way = "east"\n[[objects]]'.replace("8]", "5]"), "aisles[0].x: "),
        (
            "[[objects]]",
            f'{AISLE}one_way = "east"\n{AISLE}one_way = "west"\n[[objects]]'.replace("lane", "lane 2", 1),
            "aisles[1]: 'lane' overlaps 'lane 2' (aisles[0]), which goes the other way",
        ),
        ("[[objects]]", f'{AISLE}one_way = "east"\n' * 2 + "[[objects]]", "aisles[1].name: there are two of 'lane'"),
        ('at = "gate 1"', 'at = "dock 9"', "objects[0].at: there is no place 'dock 9'"),
        ('at = "gate 1"', 'at = "gate 1"\nsize = 0', "objects[0].size: "),
        ('name = "yard"', 'name = "yard"\nspeed_limit_mps = 0', "speed_limit_mps: "),
        ('name = "yard"', 'name = "yard"\nlatitude_deg = 95', "latitude_deg: "),
        ('name = "yard"', "name = ", "cannot be read"),
    ],
)
def test_a_wrong_site_names_file_and_key(tmp_path: Path, old: str, new: str, key: str) -> None:
    """Whatever is wrong in a site is a ConfigError with the file and the key, and says what to do."""
    file = tmp_path / "yard.toml"
    assert old in SITE
    file.write_text(SITE.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        load_site(file)
    assert str(file) in caught.value.message
    assert key in caught.value.message
    assert caught.value.remedy


def test_a_site_without_places_is_refused(tmp_path: Path) -> None:
    """A map that names no place can guide nobody."""
    (tmp_path / "empty.toml").write_text('name = "empty"\n')
    with pytest.raises(ConfigError, match="places: a site needs"):
        load_site(tmp_path / "empty.toml")


@pytest.mark.parametrize("where", ["atlantis", "/nowhere/site.toml", "../catalogue"])
def test_an_unknown_site_lists_the_known(where: str) -> None:
    """A name that no site has is refused, with those there are."""
    with pytest.raises(ConfigError) as caught:
        load_site(where)
    assert "warehouse" in caught.value.remedy
