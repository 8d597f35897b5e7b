"""Reads and checks recipes: what is wrong is said with file and key before anything begins.

A recipe is one TOML file (docs/learning.md), read strictly, so that a typing error is no silent default.
"""

import contextlib
import math
import tomllib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from appliance.errors import ConfigError, PayloadError, RefusedError
from appliance.learn import rounds, secagg
from appliance.model.keys import check_name
from appliance.model.learn_api import DataFound
from appliance.model.learning import Clients, Mode, Recipe
from appliance.skills._lib.learning import masks, robust

BUILT_IN = Path(__file__).parent / "recipes"
"""Recipes of the models that come with the product, `NAME.toml`."""
ROBOT = "{robot}"
"""In the name or folder of data: the robot whose they are."""
_HELP = "see docs/learning.md for the keys"
_SPLITS = ("speaker", "site", "even")


def built_in() -> tuple[str, ...]:
    """Return the names of the recipes that come with the product."""
    return tuple(sorted(path.stem for path in BUILT_IN.glob("*.toml")))


def find(name: str) -> Path:
    """Return the file of a recipe given as a path or as the name of one that comes with the product.

    Raises:
        ConfigError: there is none.
    """
    path = Path(name)
    with contextlib.suppress(OSError, ValueError, RuntimeError):  # what is no path, or of a user that does not exist
        path = path.expanduser()
        if path.is_file():
            return path
    if name in built_in():
        return BUILT_IN / f"{name}.toml"
    raise ConfigError(f"no recipe {name!r}", remedy=f"give a file, or one of {', '.join(built_in())}")


def load(path: Path) -> Recipe:
    """Read a recipe; ConfigError names file and key."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"recipe {path} cannot be read: {error}", remedy="give a TOML file") from error
    return parse(text, str(path))


def parse(text: str, source: str) -> Recipe:
    """Read the text of a recipe; ConfigError names `source` and key."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source} is not TOML: {error}", remedy=_HELP) from error
    return read_table(table, source)


def read_table(table: dict[str, Any], source: str) -> Recipe:
    """Return the recipe of a table; ConfigError names `source` and key."""
    try:
        recipe = msgspec.convert(table, Recipe)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {error}", remedy=_HELP) from error
    check(recipe, source)
    return recipe


def for_robots(recipe: Recipe, robots: tuple[str, ...], source: str) -> Recipe:
    """Return a recipe whose clients are robots, each with the data at its gateway; ConfigError where it cannot be so.

    How many of them take part in a round stays, where there are as many.
    """
    clients = recipe.clients
    per_round = clients.per_round if clients.per_round <= len(robots) else 0
    wanted = replace(recipe, clients=Clients(
        robots=robots, per_round=per_round, over_selection=clients.over_selection, fair_after=clients.fair_after
    ))  # fmt: skip
    check(wanted, source)
    return wanted


def check(recipe: Recipe, source: str) -> None:
    """Check what types cannot tell; ConfigError names `source` and key."""

    def wrong(key: str, message: str, remedy: str) -> ConfigError:
        return ConfigError(f"{source}: {key}: {message}", remedy=remedy)

    clients, limits = recipe.clients, recipe.rounds
    try:
        check_name(recipe.model, "model")
        for robot in clients.robots:
            check_name(robot, "robot")
    except PayloadError as error:
        raise ConfigError(f"{source}: {error.message}", remedy=error.remedy) from error
    _check_data_set(recipe, wrong)
    if bool(clients.robots) == bool(clients.partitions):
        raise wrong("clients", "there are none" if not clients.robots else "robots and partitions are both given",
                    "give robots, or partitions above 0")  # fmt: skip
    if len(set(clients.robots)) < len(clients.robots):
        raise wrong("clients.robots", "a robot is listed twice", "list each once")
    _check_split(clients.by, wrong)
    count = len(recipe.names)
    per_round = clients.per_round or count
    if per_round > count:
        raise wrong("clients.per_round", f"{per_round} of {count} clients", f"at most {count}")
    if limits.at_least > per_round:
        raise wrong("rounds.at_least", f"{limits.at_least} of {per_round} clients of a round", f"at most {per_round}")
    _check_share(recipe, wrong)
    if str(recipe.mode) not in Mode.__members__.values():
        raise wrong("rounds.mode", f"{str(recipe.mode)!r}", f"one of {', '.join(Mode.__members__.values())}")
    if limits.target is not None and not recipe.evaluation.every:
        raise wrong("rounds.target", "is never measured", "set evaluation.every above 0")
    try:
        rule = rule_of(recipe.update.rule)
        if rule["name"] == "trimmed":
            robust.trimmed_count(per_round, float(rule["share"]))
        elif rule["name"] == "multikrum":
            robust.check_krum(per_round, int(rule["hostile"]))
    except ValueError as error:
        raise wrong("update.rule", str(error), "mean, median, trimmed:SHARE or multikrum:HOSTILE") from error
    if recipe.update.dp is not None and recipe.update.rule != "mean":
        raise wrong(
            "update.rule", f"{recipe.update.rule} with update.dp, whose noise is for a mean", 'set it to "mean"'
        )
    if recipe.update.secagg:
        _check_secagg(recipe, wrong)
    unknown = sorted(recipe.emulation.speeds.keys() - set(recipe.names))
    if unknown:
        raise wrong("emulation.speeds", f"no client {unknown[0]!r}", f"clients are {', '.join(recipe.names[:8])}")
    if recipe.emulation.speeds and recipe.emulation.nominal_batch_s is None:
        raise wrong("emulation.nominal_batch_s", "is missing", "seconds that a batch takes a nominal device")


def _check_secagg(recipe: Recipe, wrong: Callable[[str, str, str], ConfigError]) -> None:
    """Secure aggregation goes with what needs the sum of one cohort's updates and nothing of a single one."""
    masked = "update.secagg is true, and nothing of a single update can be read"
    if recipe.rounds.mode not in (Mode.AUTO, Mode.SYNC):
        raise wrong("rounds.mode", f"{recipe.rounds.mode} with update.secagg, whose masks cancel for one cohort only",
                    'leave it out, or set it to "sync"')  # fmt: skip
    if recipe.update.rule != "mean":
        raise wrong("update.rule", f"{recipe.update.rule} compares updates: {masked}", 'set it to "mean"')
    if recipe.update.compression != "none":
        raise wrong("update.compression", f"{recipe.update.compression} with update.secagg, whose masks need all bits",
                    'set it to "none"')  # fmt: skip
    if recipe.training.checkpoint_steps:
        raise wrong("training.checkpoint_steps", "with update.secagg: a checkpoint is an update without masks",
                    "set it to 0")  # fmt: skip
    if not recipe.clients.robots:
        raise wrong("update.secagg", "with partitions of a data set that all gateways have: there is nothing to hide",
                    "name clients.robots, each with data of its own")  # fmt: skip
    wanted = recipe.clients.per_round or len(recipe.names)
    chosen = min(len(recipe.names), math.ceil(wanted * recipe.clients.over_selection))
    if wanted < secagg.LEAST:
        raise wrong("update.secagg", f"with {wanted} clients a round: the sum of two tells each the other's update",
                    f"take at least {secagg.LEAST}")  # fmt: skip
    if wanted < secagg.threshold(chosen):
        raise wrong("clients.over_selection", f"{wanted} of {chosen} clients are waited for, masks of that cohort need "
                    f"{secagg.threshold(chosen)}", "lower it")  # fmt: skip


def check_secure(recipe: Recipe, places: Mapping[str, str], most_samples: int) -> None:
    """Check of secure aggregation what the fleet decides.

    Args:
        recipe: of the run.
        places: client -> its gateway, of those that are there.
        most_samples: items of the largest data set; 0: not known.

    Raises:
        ConfigError: a sum may not fit, or a gateway has the keys of so many that it could read the others' updates.
    """
    if not recipe.update.secagg:
        return
    if not most_samples:
        raise ConfigError(
            "recipe: update.secagg: how many samples clients have is not known, so sums may not fit",
            remedy="see that the robots' gateways answer",
        )
    try:
        masks.check_bits(len(recipe.names), most_samples if recipe.update.dp is None else 1)
        if not recipe.clients.per_round:
            secagg.check_spread(places)
    except (ValueError, RefusedError) as error:
        raise ConfigError(
            f"recipe: update.secagg: {error}", remedy="secure aggregation needs robots at several gateways"
        ) from error


def _check_data_set(recipe: Recipe, wrong: Callable[[str, str, str], ConfigError]) -> None:
    if recipe.data.name and recipe.data.folder:
        raise wrong("data", "has both name and folder", "give one of them")
    if ROBOT not in recipe.data.name + recipe.data.folder:
        return
    if not recipe.clients.robots:
        raise wrong("data", f"{ROBOT} without clients.robots", "name the data set that is split among the clients")
    if recipe.evaluation.every and not recipe.evaluation.data:
        raise wrong("evaluation.data", "is missing where each robot has data of its own",
                    "name a data set that the gateways have, or set evaluation.every = 0")  # fmt: skip


def _check_share(recipe: Recipe, wrong: Callable[[str, str, str], ConfigError]) -> None:
    if recipe.clients.robots and recipe.data.share == "fleet":
        raise wrong("data.share", '"fleet" with clients.robots, whose data are at their own gateways only',
                    'set it to "gateway", or give partitions of a data set that all gateways have')  # fmt: skip
    if recipe.mode is Mode.OFFLOAD and recipe.data.share == "never":
        raise wrong("rounds.mode", 'offload with data.share = "never"', 'set data.share to "gateway" or "fleet"')


def _check_split(by: str, wrong: Callable[[str, str, str], ConfigError]) -> None:
    kind, colon, alpha = by.partition(":")
    if by in _SPLITS:
        return
    try:
        good = kind == "dirichlet" and bool(colon) and 0.0 < float(alpha) <= 1e6
    except ValueError:
        good = False
    if not good:
        raise wrong("clients.by", f"{by[:40]!r}", f"{', '.join(_SPLITS)} or dirichlet:ALPHA with ALPHA above 0")


def rule_of(text: str) -> dict[str, str | float | int]:
    """Return a rule as `aggregate` takes it; ValueError where there is none of that name."""
    name, _, value = text.partition(":")
    if name in ("mean", "median") and not value:
        return {"name": name}
    if name == "trimmed" and value:
        return {"name": name, "share": float(value)}
    if name == "multikrum" and value:
        return {"name": name, "hostile": int(value)}
    raise ValueError(f"no rule {text[:40]!r}")


def data_path(recipe: Recipe, client: str) -> str:
    """Return the path of a client's data in the folder of data sets; without a client, as the recipe has it."""
    path = recipe.data.folder or recipe.data.name or recipe.model
    return path.replace(ROBOT, client) if client else path


def shared_data(recipe: Recipe, gateways: Mapping[str, str]) -> dict[str, str]:
    """Return the robots whose data are those of another robot at the same gateway -> that robot.

    Args:
        recipe: of the run.
        gateways: robot -> its gateway.
    """
    if ROBOT in recipe.data.folder + recipe.data.name:
        return {}
    first: dict[str, str] = {}
    shared: dict[str, str] = {}
    for robot in recipe.clients.robots:
        gateway = gateways.get(robot, "")
        if gateway and first.setdefault(gateway, robot) != robot:
            shared[robot] = first[gateway]
    return shared


def check_shared(recipe: Recipe, gateways: Mapping[str, str]) -> None:
    """Raise ConfigError where the same data would count for two robots; arguments as of `shared_data`."""
    for robot, other in shared_data(recipe, gateways).items():
        raise ConfigError(
            f"clients.robots: {other} and {robot} are both at {gateways[robot]}, where {data_path(recipe, '')!r} would "
            f"count for each of them",
            remedy=f'give each its own, such as data.folder = "{ROBOT}/{data_path(recipe, "")}", or list one of them',
        )


def check_data(recipe: Recipe, found: Mapping[tuple[str, str], DataFound]) -> int:
    """Return how many items the largest data set has; 0 where no gateway has told.

    Args:
        recipe: of the run.
        found: gateway and path -> what is there.

    Raises:
        ConfigError: no gateway has the data set, a robot's gateway does not, or classes differ.
    """
    missing = {place: each.missing for place, each in found.items() if each.missing}
    there = {place: each for place, each in found.items() if not each.missing}
    if missing and (recipe.clients.robots or not there):
        (gateway, path), reason = min(missing.items())
        raise ConfigError(
            f"recipe: data: {path!r} at {gateway}: {reason}",
            remedy="put it into the folder that pool.folders.learning names there, or name another data set",
        )
    if there:
        first, wanted = min(there.items())
        for place, each in sorted(there.items()):
            if each.classes != wanted.classes:
                raise ConfigError(
                    f"recipe: data: class lists differ: {path_of(place)} against {path_of(first)}: "
                    f"{rounds.other_classes(each.classes, wanted.classes)}",
                    remedy="give all clients data with the same classes, in the same order",
                )
    return max((each.items for each in there.values()), default=0)


def path_of(place: tuple[str, str]) -> str:
    """Name a data set at a gateway."""
    return f"{place[1]!r} at {place[0]}"


def check_robots(recipe: Recipe, known: Collection[str]) -> None:
    """Raise ConfigError where a robot of a recipe is not known to the fleet."""
    missing = [robot for robot in recipe.clients.robots if robot not in known]
    if missing:
        raise ConfigError(
            f"clients.robots: no robot {missing[0]!r} in the fleet", remedy="`swiftbot robots` lists those there are"
        )
