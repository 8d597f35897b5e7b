"""A site's own pairs for fine-tuning: instructions with plans, from cases with gold plans or from task records.

Only what can be learned from comes in: of task records those that succeeded with the plan as the decomposer or a person
made it. Robots that the plan names are left as the instruction names them.
"""

from collections.abc import Iterable
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance.errors import NotFoundError, PlanError
from appliance.llm.preprocessing import refused
from appliance.llm.words import MAX_WORDS, words_of
from appliance.model import Plan, TaskState
from appliance.skills.catalogue import Catalogue
from workshop.corpus.notation import Pair
from workshop.train.examples import Example, example_of, is_exact

HELD_OUT = 10
"""One in so many of a site's pairs is held out, to see what tuning has brought."""


class Logged(Struct):
    """A line: a case with `gold`, or a task record with `plan`."""

    instruction: str
    robots: tuple[str, ...] = ()
    gold: Plan | None = None
    plan: Plan | None = None
    state: TaskState | None = None
    revised: int = 0


class Pairs(Struct, frozen=True, kw_only=True):
    """What a file came to."""

    train: tuple[Example, ...]
    held_out: tuple[Example, ...]
    left_out: tuple[str, ...]
    """Lines that are no pair to learn from: number and reason."""


def read_pairs(path: Path, catalogue: Catalogue) -> Pairs:
    """Read a JSONL file of pairs.

    Raises:
        NotFoundError: there is no such file.
    """
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as error:
        raise NotFoundError(
            f"no plans at {path}: {error.strerror}", remedy="give JSONL with `instruction` and `gold` or `plan`"
        ) from error
    found: list[Example] = []
    left_out: list[str] = []
    seen: set[tuple[str, ...]] = set()
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        example = _example(line, catalogue)
        if isinstance(example, str):
            left_out.append(f"{path}:{number}: {example}"[:300])
        elif (*example.words, *example.symbols) not in seen:
            seen.add((*example.words, *example.symbols))
            found.append(example)
    held_out = found[HELD_OUT - 1 :: HELD_OUT]
    return Pairs(train=tuple(_without(found, held_out)), held_out=tuple(held_out), left_out=tuple(left_out))


def _example(line: bytes, catalogue: Catalogue) -> Example | str:
    try:
        logged = msgspec.json.decode(line, type=Logged)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        return f"no pair: {error}"
    plan = logged.gold or logged.plan
    if plan is None or not plan.subtasks:
        return "it has no plan"
    if logged.gold is None and (logged.state is not TaskState.SUCCEEDED or logged.revised):
        how = "revised" if logged.revised else str(logged.state or "not carried out")
        return f"the task was {how}: there is nothing to learn from it"
    if problem := refused(logged.instruction):
        return problem.message
    if unknown := [each.skill for each in plan.subtasks if each.skill not in catalogue.skills]:
        return f"the catalogue has no skill {unknown[0]!r}: give its folder with --skills"
    if len(words_of(logged.instruction, logged.robots)) > MAX_WORDS:
        return f"more than {MAX_WORDS} words"
    pair = Pair(instruction=logged.instruction, robots=logged.robots, domain=plan.domain, subtasks=plan.subtasks)
    try:
        example = example_of(pair, catalogue)
        return example if is_exact(example, catalogue) else "its plan cannot be said in the plan language"
    except (PlanError, KeyError, ValueError, IndexError) as error:
        return f"its plan cannot be said in the plan language: {error}"


def _without(found: Iterable[Example], others: Iterable[Example]) -> list[Example]:
    gone = {id(each) for each in others}
    return [each for each in found if id(each) not in gone]
