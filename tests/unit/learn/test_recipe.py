"""Recipes: what is read, and what is refused before anything begins, with file and key."""

from pathlib import Path

import pytest
from msgspec.structs import replace

from appliance.errors import ConfigError
from appliance.learn import recipe
from appliance.model.learn_api import DataFound
from appliance.model.learning import Mode

MASKED = 'model = "clips"\n[clients]\nrobots = ["a", "b", "c", "d", "e", "f", "g"]\n[update]\nsecagg = true\n'
PLAIN = 'model = "clips"\n[clients]\npartitions = 8\n'


def test_what_is_not_said_has_its_usual_value() -> None:
    """A model and clients are enough."""
    made = recipe.parse(PLAIN, "r.toml")
    assert made.mode is Mode.PARTIAL
    assert made.names == tuple(f"part-{number:03d}" for number in range(8))
    assert (made.rounds.close_at, made.rounds.max_staleness, made.rounds.deadline) == (0.75, 5, 1.3)


def test_slow_clients_work_is_offloaded_where_samples_may_be_shared() -> None:
    """The mode follows from `share` unless the recipe says which."""
    assert recipe.parse(PLAIN + '[data]\nshare = "fleet"\n', "r.toml").mode is Mode.OFFLOAD
    assert recipe.parse(PLAIN + '[data]\nshare = "fleet"\n[rounds]\nmode = "sync"\n', "r.toml").mode is Mode.SYNC


@pytest.mark.parametrize("name", recipe.built_in())
def test_the_products_own_recipes_are_sound(name: str) -> None:
    """Each is read and checked."""
    assert recipe.load(recipe.find(name)).model == name


def test_the_recipe_of_the_documentation_is_sound() -> None:
    """What people copy from there is read."""
    text = (Path(__file__).parents[3] / "docs/learning.md").read_text()
    example = text.partition("## Recipes")[2].partition("```toml\n")[2].partition("```")[0]
    assert recipe.parse(example, "docs/learning.md").names[0] == "part-000"


def test_a_recipe_is_found_by_name_or_path(tmp_path: Path) -> None:
    """A file comes first; what is neither is refused with the names there are."""
    file = tmp_path / "mine.toml"
    file.write_text(PLAIN)
    assert recipe.find(str(file)) == file
    with pytest.raises(ConfigError, match="no recipe 'nothing'") as caught:
        recipe.find("nothing")
    assert "clips" in caught.value.remedy
    with pytest.raises(ConfigError, match=r"absent\.toml cannot be read"):
        recipe.load(tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("model = ", "not TOML"),
        ('modle = "clips"', "modle"),
        ("[clients]\npartitions = 2", "model"),
        ('model = "../x"\n[clients]\npartitions = 2', "model"),
        ('model = "clips"', "clients: there are none"),
        ('model = "clips"\n[clients]\npartitions = 0', "clients: there are none"),
        ('model = "clips"\n[clients]\npartitions = 2\nrobots = ["a"]', "robots and partitions"),
        ('model = "clips"\n[clients]\nrobots = ["a", "a"]', "clients.robots"),
        ('model = "clips"\n[clients]\nrobots = ["a", "b"]\n[data]\nshare = "fleet"', "data.share"),
        ('model = "clips"\n[clients]\npartitions = 5000', "partitions"),
        (PLAIN + 'by = "moon"', "clients.by"),
        (PLAIN + 'by = "dirichlet:0"', "clients.by"),
        (PLAIN + 'by = "dirichlet:nan"', "clients.by"),
        (PLAIN + "per_round = 9", "clients.per_round"),
        (PLAIN + '[rounds]\nmode = "fast"', "rounds.mode"),
        (PLAIN + '[rounds]\nmode = "offload"', "rounds.mode"),
        (PLAIN + "[rounds]\nclose_at = 1.5", "close_at"),
        (PLAIN + "[rounds]\nat_least = 9", "rounds.at_least"),
        (PLAIN + "[rounds]\ntarget = 0.9\n[evaluation]\nevery = 0", "rounds.target"),
        (PLAIN + '[data]\nname = "a"\nfolder = "b"', "data"),
        (PLAIN + '[data]\nshare = "everybody"', "data.share"),
        (PLAIN + '[update]\nrule = "sum"', "update.rule"),
        (PLAIN + '[update]\nrule = "trimmed:0.5"', "update.rule"),
        (PLAIN + '[update]\nrule = "multikrum:3"', "update.rule: multikrum:3 needs at least 9 updates"),
        (PLAIN + "[emulation]\nnominal_batch_s = 0.1\nspeeds = {part-009 = 5.0}", "emulation.speeds"),
        (PLAIN + "[emulation]\nspeeds = {part-001 = 5.0}", "emulation.nominal_batch_s"),
        (PLAIN + "[privacy]\nsecagg = true", "privacy"),
        (PLAIN + "[update]\nsecagg = true", "update.secagg: with partitions"),
        (PLAIN + '[update]\nrule = "median"\ndp = {clip = 1.0, noise = 1.0}', "update.rule: median with update.dp"),
        (PLAIN + "[update]\ndp = {clip = 0.0, noise = 1.0}", "update.dp.clip"),
        (PLAIN + "[update]\ndp = {clip = 1.0, noise = 0.0}", "update.dp.noise"),
        (PLAIN + "[update]\ndp = {clip = 1.0}", "noise"),
        (PLAIN + "[update]\ndp = {clip = 1.0, noise = 1.0, delta = 1.0}", "update.dp.delta"),
        (MASKED + 'rule = "median"', "update.rule: median compares updates"),
        (MASKED + 'rule = "multikrum:1"', "update.rule"),
        (MASKED + 'compression = "int8"', "update.compression"),
        (MASKED + '[rounds]\nmode = "buffered"', "rounds.mode: buffered with update.secagg"),
        (MASKED + '[rounds]\nmode = "partial"', "rounds.mode: partial with update.secagg"),
        (MASKED + "[training]\ncheckpoint_steps = 5", "training.checkpoint_steps"),
        (MASKED.replace("clients]", "clients]\nper_round = 2"), "update.secagg: with 2 clients a round"),
        (MASKED.replace("clients]", "clients]\nper_round = 3\nover_selection = 3"), "clients.over_selection"),
        (PLAIN + '[data]\nfolder = "{robot}/clips"', "data: {robot}"),
        (
            'model = "clips"\n[clients]\nrobots = ["a"]\n[data]\nfolder = "{robot}/clips"\n',
            "evaluation.data",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_file_and_key(text: str, named: str) -> None:
    """The message begins with the file and has the key in it."""
    with pytest.raises(ConfigError) as caught:
        recipe.parse(text, "r.toml")
    assert caught.value.message.startswith("r.toml")
    assert named in caught.value.message
    assert caught.value.remedy


def test_robots_that_are_not_in_the_fleet_are_refused() -> None:
    """By name."""
    made = recipe.parse('model = "clips"\n[clients]\nrobots = ["rover_1", "rover_9"]', "r.toml")
    with pytest.raises(ConfigError, match="rover_9"):
        recipe.check_robots(made, {"rover_1"})


def test_the_same_data_do_not_count_for_two_robots() -> None:
    """Two at one gateway: refused with the remedy, unless each has a folder of its own there."""
    two = 'model = "clips"\n[clients]\nrobots = ["rover_1", "rover_2", "rover_3"]\n'
    gateways = {"rover_1": "gw-1", "rover_2": "gw-2", "rover_3": "gw-1"}
    plain = recipe.parse(two, "r.toml")
    assert recipe.shared_data(plain, gateways) == {"rover_3": "rover_1"}
    with pytest.raises(ConfigError, match="rover_1 and rover_3 are both at gw-1") as caught:
        recipe.check_shared(plain, gateways)
    assert "{robot}/clips" in caught.value.remedy
    recipe.check_shared(plain, gateways | {"rover_3": ""})
    own = recipe.parse(two + '[data]\nfolder = "{robot}/clips"\n[evaluation]\ndata = "clips"', "r.toml")
    recipe.check_shared(own, gateways)
    assert recipe.data_path(own, "rover_3") == "rover_3/clips"


def found(**changes: object) -> DataFound:
    """A data set of two classes."""
    return replace(DataFound(path="clips", classes=("Run", "Walk"), items=40), **changes)  # pyright: ignore[reportArgumentType]


def test_data_that_no_gateway_has_are_refused() -> None:
    """With the place and the reason; that some of the gateways lack them is no error with partitions."""
    made = recipe.parse(PLAIN, "r.toml")
    missing = found(missing="/data/clips has neither", classes=(), items=0)
    with pytest.raises(ConfigError, match="data: 'clips' at gw-1: /data/clips has neither") as caught:
        recipe.check_data(made, {("gw-1", "clips"): missing, ("gw-2", "clips"): missing})
    assert "pool.folders.learning" in caught.value.remedy
    assert recipe.check_data(made, {("gw-1", "clips"): missing, ("gw-2", "clips"): found()}) == 40
    assert recipe.check_data(made, {}) == 0
    robots = recipe.parse('model = "clips"\n[clients]\nrobots = ["a", "b"]', "r.toml")
    with pytest.raises(ConfigError, match="at gw-1"):
        recipe.check_data(robots, {("gw-1", "clips"): missing, ("gw-2", "clips"): found()})


def test_class_lists_that_differ_between_clients_are_refused() -> None:
    """Another class, or the same in another order: the outputs of the model would mean different things."""
    made = recipe.parse(PLAIN, "r.toml")
    other = found(classes=("Run", "Swim"))
    with pytest.raises(ConfigError, match=r"at gw-2 against 'clips' at gw-1: .* without Walk and with Swim"):
        recipe.check_data(made, {("gw-1", "clips"): found(), ("gw-2", "clips"): other})
    with pytest.raises(ConfigError, match="in another order"):
        recipe.check_data(made, {("gw-1", "clips"): found(), ("gw-2", "clips"): found(classes=("Walk", "Run"))})
    assert recipe.check_data(made, {("gw-1", "clips"): found(items=30), ("gw-2", "clips"): found()}) == 40


def test_of_secure_aggregation_the_fleet_decides_too() -> None:
    """Sums that may not fit, data of unknown size, a gateway with a majority of the robots: refused at the start."""
    made = recipe.parse(MASKED, "r.toml")
    assert made.mode is Mode.SYNC
    spread = {robot: f"gw-{number % 3}" for number, robot in enumerate(made.clients.robots)}
    recipe.check_secure(made, spread, 9000)
    for places, most, told in (
        (spread, 0, "how many samples clients have is not known"),
        (spread, 1 << 30, "62 are there"),
        (dict.fromkeys(spread, "gw-1") | {"a": "gw-2"}, 9000, "6 of 7 clients are at gw-1"),
        ({"a": "gw-1", "b": "gw-2"}, 9000, "at least 3"),
    ):
        with pytest.raises(ConfigError, match=told):
            recipe.check_secure(made, places, most)
    recipe.check_secure(recipe.parse(PLAIN, "r.toml"), {}, 0)
