"""Constraints that an instruction states in words: deadlines, time windows, rates, bounds, named data sets. Pure."""

import re

from msgspec import Struct

from appliance.llm.language.values import quantity

DATASETS = (
    "3dmatch", "replica", "scannet", "matterport3d", "habitat", "tum rgb-d", "tum", "kitti", "nuscenes", "waymo open",
    "euroc", "newer college", "oxford robotcar", "coco", "imagenet", "cifar-10", "cifar-100", "mnist", "fashion-mnist",
    "ucf101", "ucf-101", "hmdb51", "kinetics-400", "kinetics", "something-something", "librispeech", "common voice",
    "tedlium", "voxceleb", "argoverse", "semantickitti", "s3dis", "modelnet40", "shapenet", "ycb", "openloris",
)  # fmt: skip
"""Public data sets that robot and perception work names; a site's own are found by their parameter."""
_NUMBER = (
    r"(?:\d+(?:[.,]\d+)?|half an?|a quarter of an|an?|one|two|three|four|five|six|seven|eight|nine|ten|twelve|fifteen|"
    r"twenty|thirty|forty|fifty|sixty|ninety)(?:[ -](?:and a half|one|two|three|four|five))?"
)
_TIME = r"(?:ms|milliseconds?|s|secs?|seconds?|m|mins?|minutes?|h|hrs?|hours?|days?)"
_LENGTH = r"(?:m|metres?|meters?|cm|centimetres?|centimeters?|km|kilometres?|kilometers?|ft|feet)"
_SPEED = r"(?:m/s|mps|km/h|kmh|kph|knots?|metres? (?:per|a) second|meters? (?:per|a) second)"
_DAY = r"noon|midnight|sunset|sunrise|dawn|dusk|nightfall"
_CLOCK = rf"(?:[01]?\d|2[0-3])[:.][0-5]\d(?: ?[ap]m)?|(?:1[0-2]|[1-9]) ?[ap]m|{_DAY}"
_MOVING = r"(?:moving |sliding |rolling )?"


def _pattern(*parts: str) -> re.Pattern[str]:
    return re.compile("".join(parts))


_PATTERNS = (
    ("deadline", "s", _pattern(
        r"\b(?:within|in under|in less than|no later than|in at most)(?: the next)? ", rf"({_NUMBER} ?{_TIME})\b")),
    ("clock", "", _pattern(rf"\b(?:by|before|until|no later than) ({_CLOCK})\b")),
    ("window", "ms", _pattern(rf"\b{_MOVING}windows?(?: of| size(?: of)?|:)? ({_NUMBER} ?{_TIME})\b")),
    ("window", "ms", _pattern(rf"\b({_NUMBER}[ -]?{_TIME})[ -]{_MOVING}windows?\b")),
    ("period", "s", _pattern(rf"\bevery ({_NUMBER} ?{_TIME})\b")),
    ("duration", "s", _pattern(rf"\bfor (?:about |at least |at most )?({_NUMBER} ?{_TIME})\b")),
    ("speed", "mps", _pattern(
        r"\b(?:at|below|under|no faster than|not faster than|at most) ", rf"({_NUMBER} ?{_SPEED})")),
    ("distance", "m", _pattern(
        rf"\b(?:at least|keep|stay|maintain) ({_NUMBER} ?{_LENGTH}) (?:away|apart|from|distance)")),
    ("altitude", "m", _pattern(
        r"\b(?:at|to|below|under|above)(?: an altitude of| a height of)? ", rf"({_NUMBER} ?{_LENGTH})\b(?!/)")),
)  # fmt: skip
_ORDER = ("deadline", "clock", "window", "period", "duration", "distance", "speed", "altitude", "dataset")


class Constraint(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One of them. `value` in `unit`; a data set or a time of day stands in `text` alone."""

    kind: str
    text: str
    """As it was said."""
    value: float | None = None
    unit: str = ""


def constraints(instruction: str) -> tuple[Constraint, ...]:
    """Return the constraints that an instruction states, in a fixed order of kinds."""
    text = " ".join(instruction.casefold().split())
    found: list[Constraint] = []
    taken: list[tuple[int, int]] = []
    for kind, unit, pattern in _PATTERNS:
        for match in pattern.finditer(text):
            span = match.span(1)
            if any(span[0] < end and start < span[1] for start, end in taken):
                continue  # "a window of 400 ms" is no duration besides
            value = quantity(match[1].replace("-", " "), unit) if unit else None
            if unit and value is None:
                continue
            taken.append(span)
            found.append(Constraint(kind=kind, text=match[0], value=None if value is None else float(value), unit=unit))
    covered = ""
    for name in sorted(DATASETS, key=len, reverse=True):
        if re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", text) and name not in covered:
            covered += f" {name}"
            found.append(Constraint(kind="dataset", text=name))
    return tuple(sorted(found, key=lambda each: (_ORDER.index(each.kind), text.find(each.text))))
