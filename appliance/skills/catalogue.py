"""The skill catalogue: what a subtask may be, what it needs and gives, and whether it can really be done here.

Why it exists: the planner, the pool and the task manager must agree on one list of skills, and adding a skill
must be adding a folder. So the list is the folders: `appliance/skills/<id>/skill.toml` is the manifest, and a
`handler.py` beside it makes the skill one that can run. A skill without handler is known to the planner, which
answers "skill not implemented" instead of guessing at another. Images are folders too
(`images/<name>/image.toml`, with the Containerfile beside it).

Loading is strict: an unknown key, a wrong type, a duplicated id or an image that is not there is a ConfigError
with file and key, because a manifest that is half understood fails later, in a container, far from its cause.

A run's result is held against the outputs that the manifest promises: later subtasks, conditions and reports read
results by name; one that lacks a value, or has another type, would fail there, far from the handler that left it out.
"""

import hashlib
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct, field

from appliance.errors import ConfigError

SKILLS = Path(__file__).resolve().parent
"""The built-in skills; a snapshot of them is mounted read-only at `/skills` in every container."""

DOMAINS = (
    "navigation",
    "manipulation",
    "perception",
    "coordination",
    "inspection",
    "interaction",
    "media",
    "learning",
)
"""What instructions are about; a plan names one of them."""

NOT_SKILLS = frozenset({"_lib", "images", "models", "sites", "__pycache__"})
"""Folders beside the skills that hold something else: shared code of handlers, images, models, sites."""

_NAME = re.compile(r"[a-z][a-z0-9_]{0,40}")
WHEELHOUSE = "wheelhouse"
"""Folder of an image with the wheels that its `requirements.txt` pins: no part of its tag, since the pins are."""
_REPOSITORY = "localhost/swiftbot"
_Kind = TypeVar("_Kind")

Word = Annotated[str, Meta(min_length=1, max_length=60)]
Phrase = Annotated[str, Meta(min_length=1, max_length=60)]


class Param(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One parameter of a skill; `description` helps people and the planner."""

    type: Literal["string", "number", "integer", "array"]
    required: bool
    description: str = ""
    usual: float | Annotated[str, Meta(min_length=1, max_length=60)] | None = None
    """What its handler takes where a plan says nothing; None: nothing fixed. The safety policy looks at it."""
    least: float | None = None
    most: float | None = None
    """Bounds of a number, or the fewest robots of a joint skill (2 where nothing is said); a plan beyond is refused."""
    names: Literal["", "place"] = ""
    """What a text names: a place of the site."""
    verbatim: bool = False
    """A text that people read or hear: it keeps the capitals of the instruction."""


class Output(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One value of a skill's result that others rely on."""

    type: Literal["string", "number", "integer", "boolean", "array", "object", "any"]
    required: bool = True
    """Whether each result has it; one that is not required may be left out or null."""
    description: str = ""


_KINDS: dict[str, Literal["string", "number", "array", "object"]] = {
    "number": "number",
    "text": "string",
    "detections": "array",
    "frames": "array",
    "path": "array",
    "image": "object",
    "video": "object",
}
"""What the values of these kinds of data are, in `produces`; of another kind they may be anything but null."""


class Alternative(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A skill that may take the place of one that was given up."""

    skill: Word
    params: dict[str, Annotated[str, Meta(max_length=200)]] = field(default_factory=dict[str, str])
    """Its parameters: `$name` is the value of ours of that name, where it is given; other text stands for itself."""


class SkillManifest(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A skill as `skill.toml` describes it. The first half is what the planner sees, the second what a run needs."""

    id: str
    domain: str
    summary: Annotated[str, Meta(min_length=1, max_length=200)]
    params: dict[str, Param] = field(default_factory=dict[str, Param])
    runs: Literal["robot", "compute"]
    """On a robot, or anywhere."""
    uses: tuple[Word, ...] = ()
    """Actuators and sensors it occupies while it runs; two subtasks of a robot that share one are ordered."""
    consumes: tuple[Word, ...] = ()
    produces: tuple[Word, ...] = ()
    """Kinds of data it makes; its result holds each under that name."""
    results: dict[str, Output] = field(default_factory=dict[str, Output])
    """What its result holds, by name; an entry named as one of `produces` is in place of that one's own type."""

    image: str
    """Image its handler runs in, a folder of `images/`."""
    cpu: Annotated[float, Meta(gt=0, le=64)] = 0.5
    """Cores a container must offer (algorithms: selection)."""
    memory_mb: Annotated[int, Meta(ge=16, le=65536)] = 128
    volumes: tuple[Word, ...] = ()
    """Named volumes it wants mounted."""
    preload: tuple[str, ...] = ()
    """Modules the zygote imports beforehand, besides the handler itself and the image's own list."""
    loads: tuple[Annotated[str, Meta(min_length=1, max_length=300)], ...] = ()
    """Files its `preload` reads: `PATH` in its own folder, or `VOLUME:PATH` in one of `volumes`."""
    preload_mb: Annotated[int, Meta(ge=0, le=65536)] = 0
    """Memory its `preload` may take; 0: it has none. A container of its image is given so much more."""
    preload_s: Annotated[float, Meta(gt=0, le=600)] = 10.0
    """Longest `preload`; all that a container loads is bounded too, by 40 % of `pool.start_timeout_s` or by `load_s` of
    its image, whichever is longer."""
    folders: tuple[Word, ...] = ()
    """Folders of the gateway's machine that it reads, mounted read-only: `pool.folders` says where each is."""
    cache: bool = False
    """Whether it keeps what it can work out again in a folder of the gateway that containers of its image share."""
    file_mb: Annotated[int, Meta(ge=1, le=1 << 20)] = 256
    """Longest file its runs may write, in a volume too; what they write there together ends where the disk is short."""
    timeout_s: Annotated[float, Meta(gt=0, le=86400)] = 120.0
    """Longest run, beyond a `duration_s` that was asked for."""
    retries: Annotated[int, Meta(ge=0, le=10)] = 1
    """Further attempts after a failure that another attempt may cure."""
    verbs: tuple[Word, ...] = ()
    """Robot commands its handler sends; a robot that lacks one cannot be given this skill."""
    prepares: tuple[Word, ...] = ()
    """State it brings its robot into, which another robot could be brought into by doing the same: `position`."""
    ties: tuple[Word, ...] = ()
    """State it leaves its robot in that no other robot has: `load`. What follows stays with that robot."""
    frees: tuple[Word, ...] = ()
    """State that it ends."""
    alternatives: tuple[Alternative, ...] = ()
    """Skills that may take its place when it is given up, best first."""
    silent_s: Annotated[float, Meta(ge=0, le=86400)] = 0.0
    """Longest that its handler goes without a sign of life: a run that is silent for longer is stuck. 0: not said."""
    speculate: bool = False
    """Whether a run that takes much longer than others may be left for a new attempt elsewhere."""
    danger: Annotated[str, Meta(max_length=120)] = ""
    """Why a person should look at a plan before this is done; empty: it is harmless. See `tasks.approval`."""
    checkpoints: bool = False
    """Whether its handler saves a checkpoint when `ctx.checkpoint_due()` says so: worth waiting for before a move."""
    migratable: Literal["", "anytime", "between commands", "never"] = ""
    """When a run may migrate to another gateway. Empty: `anytime`, or `never` if it sends robot commands."""
    opposite_of: tuple[Word, ...] = ()
    """Skills that undo it: an order for one is never carried out by the other. Of two in one folder of skills each
    names the other; what a site's skill says of a built-in one is added to that one."""
    moves_robot: bool = False
    """Whether a run takes the robot's body elsewhere, up and down too."""
    joint: bool = False
    """Whether several robots do it together, listed in its parameter `robots`."""
    flying: bool = False
    """Whether only a robot that flies can do it."""
    repeats: bool = False
    """Whether a plan may well have it twice with the same parameters though the words do not say "twice"."""
    reports: bool = False
    """Whether it only tells somebody something: nothing moves, so a condition before it needs no wait."""
    observes: bool = False
    """Whether its result says how something is, so that a condition behind it is about that result."""
    incidental: bool = False
    """Whether a plan is about its other subtasks, where it has some: this one is the way there, or reports on them."""
    feeds_on: tuple[Word, ...] = ()
    """Skills whose output it works on, wherever a plan has one."""
    at_object: Word | Literal[""] = ""
    """The parameter that names the thing its robot has to stand at; empty: none."""
    phrases: tuple[Phrase, ...] = ()
    """Verbs and verb phrases by which people ask for it, lower case, in the infinitive: the review of a plan holds the
    words of an instruction against them. A skill without any is never asked for by words alone."""

    implemented: bool = False
    """Whether `handler.py` is there. Set by the loader, never in the file."""
    folder: Path = Path()
    """Where it was read from. Set by the loader, never in the file."""

    @property
    def outputs(self) -> dict[str, Output]:
        """What its result must hold, by name: one value for each of `produces`, and what `results` says."""
        return {kind: Output(type=_KINDS.get(kind, "any")) for kind in self.produces} | self.results

    @property
    def mobility(self) -> Literal["anytime", "between commands", "never"]:
        """When a run of it may be moved to another gateway."""
        return self.migratable or ("never" if self.verbs else "anytime")


class ImageSpec(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An image as `image.toml` describes it; `pool/images.py` builds it."""

    name: str
    packages: tuple[Word, ...]
    """Debian packages it consists of."""
    preload: tuple[str, ...] = ()
    """Modules every zygote of this image imports beforehand."""
    compatible: tuple[str, ...] = ()
    """Images whose skills it can also run."""
    load_s: Annotated[float, Meta(ge=0, le=600)] = 0.0
    """Longest that a container may take to load all it preloads, for an image with large modules. The time for a start
    follows from it. 0: 40 % of `pool.start_timeout_s`."""
    on_demand: bool = False
    """Whether it is built only when it is named, or when something needs it: it takes minutes."""
    folder: Path = Path()
    """Where it was read from. Set by the loader, never in the file."""


class Catalogue(Struct, frozen=True):
    """All skills and images, by name. Shared by everyone who loads it: read, never changed."""

    domains: tuple[str, ...]
    skills: dict[str, SkillManifest]
    images: dict[str, ImageSpec]

    @property
    def verbatim(self) -> frozenset[tuple[str, str]]:
        """Skill and parameter of the texts that people read or hear."""
        return frozenset(
            (skill.id, name) for skill in self.skills.values() for name, each in skill.params.items() if each.verbatim
        )


def load_catalogue(extra: Sequence[Path] = ()) -> Catalogue:
    """Load the built-in skills and those of `extra`: folders laid out like `appliance/skills`.

    The result is kept for the life of the process: skills added later are seen after a restart.

    Raises:
        ConfigError: naming the file and the key, when anything in it is not as it should be.
    """
    return _load(tuple(Path(folder).resolve() for folder in extra))


def image_reference(image: str, *, folder: Path | None = None) -> str:
    """Return `localhost/swiftbot/<image>:<hash>`: a changed image folder or common recipe is a new image.

    The wheelhouse is left out: `requirements.txt` pins what is used of it, and a gateway that gets the image from
    another has none.

    Args:
        image: name of a folder of `images/`.
        folder: that folder itself, for an image that is not built in (`ImageSpec.folder`).

    Raises:
        ConfigError: when there is no such image.
    """
    where = folder or SKILLS / "images" / image
    if not (where / "image.toml").is_file():
        raise ConfigError(f"no image {image!r}: {where}/image.toml is missing", remedy="see docs/skills.md, Images")
    digest = hashlib.sha256((SKILLS / "images" / "recipe.toml").read_bytes())
    for file in sorted(where.rglob("*")):
        inside = file.relative_to(where)
        left_out = inside.parts[0] == WHEELHOUSE or "__pycache__" in inside.parts or file.name.startswith(".")
        if file.is_file() and not left_out:
            data = file.read_bytes()
            digest.update(f"{inside.as_posix()}\0{len(data)}\0".encode())
            digest.update(data)
    return f"{_REPOSITORY}/{image}:{digest.hexdigest()[:12]}"


@lru_cache(maxsize=16)
def _load(extra: tuple[Path, ...]) -> Catalogue:
    roots = (SKILLS, *extra)
    for root in roots:
        if not root.is_dir():
            raise ConfigError(f"{root}: no such folder of skills", remedy="create it, or take it out of the list")
    images: dict[str, ImageSpec] = {}
    skills: dict[str, SkillManifest] = {}
    for root in roots:
        for spec in _images(root):
            if spec.name in images:
                raise _wrong(
                    spec.folder / "image.toml", "name", f"image {spec.name!r} is in {images[spec.name].folder} too"
                )
            images[spec.name] = spec
    for spec in images.values():
        for other in spec.compatible:
            if other not in images:
                raise _wrong(spec.folder / "image.toml", "compatible", f"there is no image {other!r}")
    origin: dict[str, Path] = {}
    for root in roots:
        for manifest in _manifests(root):
            file = manifest.folder / "skill.toml"
            if manifest.id in skills:
                raise _wrong(file, "id", f"skill {manifest.id!r} is in {skills[manifest.id].folder} too")
            if manifest.image not in images:
                raise _wrong(
                    file, "image", f"there is no image {manifest.image!r} (known: {', '.join(sorted(images))})"
                )
            skills[manifest.id] = manifest
            origin[manifest.id] = root
    for manifest in skills.values():
        _check_alternatives(manifest, skills)
        _check_facts(manifest, skills, origin)
    skills = _with_opposites(skills)
    ordered = sorted(skills.values(), key=lambda each: (DOMAINS.index(each.domain), each.id))
    return Catalogue(DOMAINS, {each.id: each for each in ordered}, images)


def _manifests(root: Path) -> Iterator[SkillManifest]:
    for folder in _folders(root):
        file = folder / "skill.toml"
        if folder.name in NOT_SKILLS:
            continue
        if not file.is_file():
            raise ConfigError(
                f"{folder}: skill.toml is missing", remedy="write it as docs/skills.md shows, or remove the folder"
            )
        table = _read(file, {"implemented", "folder"})
        manifest = convert(file, table, SkillManifest, rows={"params": Param, "results": Output})
        _check_name(file, "id", manifest.id, folder)
        if manifest.domain not in DOMAINS:
            raise _wrong(file, "domain", f"{manifest.domain!r} is none of {', '.join(DOMAINS)}")
        for param in manifest.params:
            if not _NAME.fullmatch(param):
                raise _wrong(file, f"params.{param}", "a parameter's name is of a-z, 0-9 and '_'")
        for output in manifest.results:
            if not _NAME.fullmatch(output):
                raise _wrong(file, f"results.{output}", "a result's name is of a-z, 0-9 and '_'")
        if manifest.runs == "compute" and manifest.verbs:
            raise _wrong(file, "verbs", "a skill that runs on no robot sends no robot commands")
        if manifest.speculate and (manifest.runs == "robot" or manifest.volumes):
            raise _wrong(file, "speculate", "only for what runs on no robot and writes no volume: effects would double")
        _check_loads(file, manifest, folder)
        yield msgspec.structs.replace(manifest, implemented=(folder / "handler.py").is_file(), folder=folder)


def _check_loads(file: Path, manifest: SkillManifest, folder: Path) -> None:
    """Check what `preload` reads as far as it can be before a container is there: volumes come and go."""
    if manifest.loads and not manifest.preload_mb:
        raise _wrong(file, "preload_mb", "needed with `loads`: the memory that loading them may take")
    for name in manifest.loads:
        volume, colon, path = name.rpartition(":")
        if colon and volume not in manifest.volumes:
            raise _wrong(file, "loads", f"{name!r}: {volume!r} is none of its volumes")
        if not path or path.startswith("/") or ".." in Path(path).parts:
            raise _wrong(file, "loads", f"{name!r}: the path is to be relative and without '..'")
        if not colon and not (folder / path).exists():
            raise _wrong(file, "loads", f"{folder / path} is not there")


def _check_alternatives(manifest: SkillManifest, skills: dict[str, SkillManifest]) -> None:
    file = manifest.folder / "skill.toml"
    for each in manifest.alternatives:
        other = skills.get(each.skill)
        if other is None or other.id == manifest.id:
            raise _wrong(file, "alternatives", f"{each.skill!r} is no other skill")
        for name, source in each.params.items():
            ours, theirs = manifest.params.get(source[1:]), other.params.get(name)
            if theirs is None:
                raise _wrong(file, "alternatives", f"{other.id} has no parameter {name!r}")
            if source.startswith("$") and (ours is None or ours.type != theirs.type):
                raise _wrong(file, "alternatives", f"{source!r} is no parameter of {manifest.id} of type {theirs.type}")
            if not source.startswith("$") and theirs.type != "string":
                raise _wrong(file, "alternatives", f"{name} of {other.id} is a {theirs.type}: only text can be given")
        for name, param in other.params.items():
            if param.required and name not in each.params:
                raise _wrong(file, "alternatives", f"{other.id} needs {name}: map it in `params`")


def _check_facts(manifest: SkillManifest, skills: dict[str, SkillManifest], origin: dict[str, Path]) -> None:
    """Check what a manifest says of other skills, and of its own parameters."""
    file = manifest.folder / "skill.toml"
    for key, others in (("opposite_of", manifest.opposite_of), ("feeds_on", manifest.feeds_on)):
        for other in others:
            if other not in skills or other == manifest.id:
                raise _wrong(file, key, f"{other!r} is no other skill")
    for other in manifest.opposite_of:
        if manifest.id not in skills[other].opposite_of and origin[other] == origin[manifest.id]:
            raise _wrong(file, "opposite_of", f"{other!r} does not name {manifest.id!r} in its own")
    if manifest.moves_robot and "base" not in manifest.uses:
        raise _wrong(file, "moves_robot", "what moves the robot's body has base in `uses`")
    if manifest.flying and manifest.runs != "robot":
        raise _wrong(file, "flying", "a skill that runs on no robot needs none that flies")
    if manifest.reports and (manifest.moves_robot or manifest.danger):
        raise _wrong(file, "reports", "what only informs somebody moves nothing and is harmless")
    at = manifest.params.get(manifest.at_object)
    if manifest.at_object and (at is None or at.type != "string"):
        raise _wrong(file, "at_object", f"{manifest.at_object!r} is none of its parameters of type string")
    robots = manifest.params.get("robots")
    if manifest.joint and (robots is None or robots.type != "array" or not robots.required):
        raise _wrong(file, "joint", "needed with it: a required parameter robots of type array")
    if robots is not None and manifest.runs == "robot" and not manifest.joint:
        raise _wrong(file, "joint", "needed with a parameter robots: its robots are bound and stopped together")
    for phrase in manifest.phrases:
        if phrase != " ".join(phrase.lower().split()):
            raise _wrong(file, "phrases", f"{phrase!r}: lower case, single spaces")


def _with_opposites(skills: dict[str, SkillManifest]) -> dict[str, SkillManifest]:
    """Return the skills with `opposite_of` symmetric between folders too: a built-in skill cannot name a site's."""
    found: dict[str, SkillManifest] = {}
    for name, manifest in skills.items():
        back = [each.id for each in skills.values() if name in each.opposite_of and each.id not in manifest.opposite_of]
        opposites = (*manifest.opposite_of, *back)
        found[name] = msgspec.structs.replace(manifest, opposite_of=opposites) if back else manifest
    return found


def _images(root: Path) -> Iterator[ImageSpec]:
    where = root / "images"
    for folder in _folders(where) if where.is_dir() else ():
        file = folder / "image.toml"
        if not file.is_file():
            raise ConfigError(f"{folder}: image.toml is missing", remedy="write it as docs/skills.md shows")
        spec = convert(file, _read(file, {"folder"}), ImageSpec)
        _check_name(file, "name", spec.name, folder)
        if not spec.packages:
            raise _wrong(file, "packages", "an image needs at least python3")
        if (folder / "requirements.txt").is_file():
            from appliance.skills.requirements import read_requirements  # noqa: PLC0415 - for images that have some

            read_requirements(folder / "requirements.txt")
        yield msgspec.structs.replace(spec, folder=folder)


def _folders(root: Path) -> Iterable[Path]:
    return sorted(
        each
        for each in root.iterdir()
        if each.is_dir() and each.name != "__pycache__" and not each.name.startswith(".")
    )


def _read(file: Path, reserved: set[str]) -> dict[str, Any]:
    """Read a TOML file; keys the loader sets itself are unknown to people."""
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}", remedy="mend the TOML there") from error
    for key in sorted(reserved & table.keys()):
        raise _wrong(file, key, "unknown key")
    return table


def convert(
    file: Path, table: dict[str, Any], kind: type[_Kind], *, rows: Mapping[str, type[Struct]] | None = None
) -> _Kind:
    """Turn a table of a file into a struct; ConfigError with file and key where it does not fit.

    `rows` are the keys that hold tables by name, each with their struct: msgspec tells no names there.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        for key, row_kind in (rows or {}).items():
            named: Any = table.get(key)
            for name, row in named.items() if isinstance(named, dict) else ():  # pyright: ignore[reportUnknownVariableType]
                try:
                    msgspec.convert(row, row_kind)
                except msgspec.ValidationError as inner:
                    raise _validation(file, inner, f"{key}.{name}") from inner
        raise _validation(file, error) from error


def _validation(file: Path, error: msgspec.ValidationError, at: str = "") -> ConfigError:
    """Turn msgspec's complaint (``… - at `$.params.x` ``) into one that names the file and the key."""
    what, _, where = str(error).partition(" - at ")
    named = re.search(r"(?:unknown|required) field `([^`]+)`", what)
    parts = [at, where.strip("`").removeprefix("$").lstrip("."), named.group(1) if named else ""]
    if named:
        what = "unknown key" if "unknown" in what else "missing"
    return _wrong(file, ".".join(part for part in parts if part) or "(whole file)", what)


def _check_name(file: Path, key: str, name: str, folder: Path) -> None:
    if not _NAME.fullmatch(name):
        raise _wrong(file, key, f"{name!r} is not a name of a-z, 0-9 and '_' that starts with a letter")
    if name != folder.name:
        raise _wrong(file, key, f"{name!r} is not the folder's name {folder.name!r}")


def _wrong(file: Path, key: str, what: str) -> ConfigError:
    return ConfigError(f"{file}: {key}: {what}", remedy="docs/skills.md lists the keys and what they hold")


_NAMES = {
    "string": "a text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "array": "a list",
    "object": "a table",
    "any": "a value",
}
SHOWN = 40
"""Characters of a value that a message shows."""


def broken_promises(manifest: SkillManifest, result: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what of a result is not as the manifest says, each with output, expected and got; empty when all is.

    Args:
        manifest: of the skill that ran.
        result: what its handler returned, decoded from JSON.
    """
    return tuple(
        text for name, output in manifest.outputs.items() if (text := _problem(name, output, result.get(name), result))
    )


def _problem(name: str, output: Output, value: Any, result: Mapping[str, Any]) -> str:
    expected = _NAMES[output.type]
    if value is None:
        if not output.required:
            return ""
        got = "null" if name in result else f"a result with {_listed(result)}"
        return f"output {name!r} is missing: expected {expected}, got {got}"
    if _fits(output.type, value):
        return ""
    return f"output {name!r} has the wrong type: expected {expected}, got {_shown(value)}"


def _fits(kind: str, value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    match kind:
        case "string":
            return isinstance(value, str)
        case "number":
            return number
        case "integer":
            return number and (isinstance(value, int) or value.is_integer())
        case "boolean":
            return isinstance(value, bool)
        case "array":
            return isinstance(value, list | tuple)
        case "object":
            return isinstance(value, Mapping)
        case _:
            return True


def _listed(result: Mapping[str, Any]) -> str:
    names = [repr(name[:SHOWN]) for name in list(result)[:8]]
    return f"{', '.join(names)}{' and more' if len(result) > 8 else ''}" if names else "nothing in it"


def _shown(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return f"the text {value[:SHOWN]!r}"
        case int() | float():
            return f"the number {value:g}" if -1e15 < value < 1e15 else "a number"
        case list() | tuple():
            return f"a list of {len(value)}"  # pyright: ignore[reportUnknownArgumentType]
        case Mapping():
            return "a table"
        case _:
            return f"a {type(value).__name__}"
