"""The robots that a small model is shown of a fleet, and its plan for them as one for the fleet. Pure.

A model that points at words gives work to whomever its prompt lists: with two robots it is right about them, with
thirty it has thirty shares to give, and its confidence falls towards zero. So a prompt lists the robots that the words
can mean and no others, whatever the size of the fleet:

- robots that the words name or number are listed;
- of a group ("all drones", "everyone except rover_5") the prompt names a few members in its place, its stand-ins; what
  the plan has each of them do is then given to every member (`Shortlist.whole`), if it has all stand-ins do the same;
- of one robot of a kind ("a drone", "the rover" where there are several) it names one in its place, which afterwards is
  the first of the kind that can do what it is given;
- where no robot is meant nothing is listed, and the plan says `any`: the roster, placement and `safety.choose_robot`
  decide who that is.

Nothing is decided here about what may run: the plan for the fleet is reviewed against the words as they were typed and
against the whole roster. A group whose stand-ins do different things stays as it is, and the review holds it.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.llm.checks.reading import Reading, Token, is_readable, normalise, read
from appliance.llm.checks.safety import robots_of
from appliance.llm.checks.schema import able
from appliance.llm.settings import PlanContext
from appliance.model import MAX_SUBTASKS, SPLIT, Plan, RobotInfo, Site, Subtask
from appliance.skills.catalogue import Catalogue

STAND_INS = 2
"""Members of a group that are shown: one could not tell whether all do the same, side by side or one after another."""
MOST_COUNTED = 4
"""Robots that are shown for "three drones"; of more the plan is left to others."""
MOST_GROUPS = 4
"""Groups of one instruction, counted apart where they overlap; with more nothing is put in their place."""
_MOST_ABILITIES = 32
"""Combinations of abilities of which a robot is kept for the checks of answers."""
NOT_DOING = frozenset(
    "to from at for of on onto into about behind beside near around towards toward follow follows following between "  # noqa: SIM905 - a list of words
    "than like notify inform warn alert remind thank greet message".split()
)
"""Words behind which robots are not those who do something: "take it to a drone"."""
_EACH = frozenset(("all", "both", "every", "each", "everyone", "everybody"))
_STARTS = frozenset(
    ". , ; : ! ? and then while but have let send tell ask get make want need with when once until after".split()  # noqa: SIM905 - a list of words
) | {"", "\n"}
"""What stands before robots in the plural that do something, where no word says that all do: "the drones land"."""
_TELLING = frozenset(("tell", "ask", "notify", "inform", "warn", "alert", "remind"))
_ANYBODY = frozenset(
    "robot robots bot bots unit units vehicle vehicles machine machines".split()  # noqa: SIM905 - a list of words
)
"""Nouns for a robot of any kind: "a robot" is what `any` says."""
_OTHER = frozenset(("other", "another"))
_EXCEPT = re.compile(
    r"\s*,?\s*(?:except(?:ing)?(?: for)?|but(?: not)?|apart from|other than|excluding)\s+", re.IGNORECASE
)
_LINK = re.compile(r"\s*(?:,\s*and|,|and|&|or)\s*", re.IGNORECASE)
_OTHERS = re.compile(
    r"(?:(?<=[.,;:!\n])|(?<=\band)|(?<=\bwhile)|(?<=\bthen)|(?<=\bbut)|(?<=\bhave)|(?<=\blet)|^)\s*"
    r"(?P<who>(?:all )?the (?:others|rest(?: of (?:them|the (?:robots|fleet|team)))?(?! of\b))"
    r"|every(?:one|body) else)\b",
    re.IGNORECASE,
)
_PIECE = re.compile(r"[^\W_]+|[^\w\s.-]")
"""What of a name counts where it is looked for: letters, figures and signs, not what parts them."""


class Group(Struct, frozen=True):
    """Robots that the words speak of as one."""

    shown: tuple[str, ...]
    """Its stand-ins."""
    members: tuple[str, ...]
    """All of them, the stand-ins included."""
    each: bool
    """Whether every member does what the stand-ins do; else as many as there are stand-ins, whichever they are."""


class Shortlist(Struct, frozen=True, kw_only=True):
    """An instruction with the robots that a model is shown."""

    instruction: str
    """With names of stand-ins for groups."""
    typed: str
    """The same, but for groups of several, which stand as they were typed."""
    names: tuple[str, ...] | None
    """The roster of the prompt; None where the fleet's is unknown."""
    robots: tuple[RobotInfo, ...] | None
    """Those, and one or two of each combination of abilities: what answers are compared by."""
    groups: tuple[Group, ...] = ()

    def forms(self, context: PlanContext) -> tuple[PlanContext, ...]:
        """Return what the model is asked and its answers are compared by: with names for groups, then as typed."""
        named = replace(context, instruction=self.instruction, robots=self.robots)
        if self.instruction == self.typed or self.robots is None:
            return (named,)
        # "All drones" are those that are shown, and no others.
        shown = tuple(each for each in self.robots if each.id in (self.names or ()))
        return named, replace(context, instruction=self.typed, robots=shown)

    def whole(self, plan: Plan, robots: Sequence[RobotInfo] | None, catalogue: Catalogue) -> Plan:
        """Return a plan for those who were shown as one for the fleet.

        Args:
            plan: over the roster of the prompt.
            robots: the fleet's roster.
            catalogue: what skills need.

        Raises:
            PlanError: it has more subtasks than a plan may have.
        """
        for group in self.groups:
            plan = _given_to_all(plan, group) if group.each else _given_to_able(plan, group, robots or (), catalogue)
        return plan


def shortlist(context: PlanContext) -> Shortlist:
    """Return what a model is shown for an instruction.

    Whatever the order of the roster, the result is the same; it has every robot that the words name, two for each
    group, at most `MOST_COUNTED` for some of a kind, and no others.
    """
    robots = context.robots
    if robots is None:
        return Shortlist(instruction=context.instruction, typed=context.instruction, names=None, robots=None)
    found = read(context.instruction, robots, site=context.site)
    roster = tuple(sorted(robots, key=lambda each: natural(each.id)))
    named = {name for each in found.tokens if each.group == "one" or each.listed for name in each.robots}
    named |= literally(context.instruction, roster)
    made = _with_stand_ins(found, roster, named, context.site)
    shown = named | made.shown
    # As it was typed where nothing is put in: what is folded for comparison is not what planners were taught.
    named_text, typed = (context.instruction if each == found.text else each for each in (made.named, made.typed))
    return Shortlist(
        instruction=named_text,
        typed=typed,
        names=tuple(each.id for each in roster if each.id in shown),
        robots=_for_checks(roster, shown),
        groups=made.groups,
    )


@lru_cache(maxsize=32_768)
def natural(robot: str) -> tuple[tuple[bool, int, str], ...]:
    """Return the key that sorts `rover_2` before `rover_10`."""
    parts = re.findall(r"\d+|\D+", robot)
    return (*((part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts), (False, 0, robot))


_LONGEST_NAME = 12
"""Pieces of a name that is looked for as it is written."""


def literally(instruction: str, robots: Iterable[RobotInfo]) -> set[str]:
    """Return the robots that a reading cannot see and whose ids stand in a text, but for case, blanks and hyphens.

    Names that begin with a figure, or have emoji or signs. `7up_1` does not stand in "7up_10".
    """
    unseen = [each.id for each in robots if not is_readable(each.id)]
    if not unseen:
        return set()
    pieces = _PIECE.findall(normalise(instruction)[0].casefold())
    said = {
        "".join(pieces[first : first + length])
        for length in range(1, _LONGEST_NAME + 1)
        for first in range(len(pieces) - length + 1)
    }
    return {each for each in unseen if (name := _squashed(each)) and name in said}


@lru_cache(maxsize=32_768)
def _squashed(robot: str) -> str:
    return "".join(_PIECE.findall((robot if robot.isascii() else normalise(robot)[0]).casefold()))


# --- what stands in place of groups ----------------------------------------------------------------------------------


class _Mention(Struct, frozen=True):
    """Where the words mean robots without a name, and which."""

    start: int
    end: int
    robots: frozenset[str]
    each: bool
    count: int = 0
    parted: bool = False
    """Whether the words leave some out: "everyone except rover_5"."""


class _StandIns(Struct, frozen=True):
    """A text with names in place of groups: of all, and of all but groups of several; who is named, and for whom."""

    named: str
    typed: str
    shown: frozenset[str] = frozenset()
    groups: tuple[Group, ...] = ()


def _with_stand_ins(found: Reading, roster: Sequence[RobotInfo], named: set[str], site: Site | None) -> _StandIns:
    order = [each.id for each in roster]
    # A robot that is named already is not named again: "rover_1 and rover_2 …, then both of them …".
    mentions = [each for each in _mentions(found, order, named, site) if not each.robots <= named]
    taken = set(named)
    groups: list[Group] = []
    names: dict[int, list[str]] = {}
    for number, each in enumerate(mentions):
        if not each.each:
            free = [name for name in order if name in each.robots and name not in taken]
            if len(free) >= each.count:
                names[number] = free[: each.count]
                taken |= set(names[number])
                groups.append(Group(tuple(names[number]), tuple(free), each=False))
    # Robots of which the words say the same are one group, where they speak of overlapping ones too.
    spoken: dict[frozenset[int], list[str]] = {}
    for name in order:
        of = frozenset(number for number, each in enumerate(mentions) if each.each and name in each.robots)
        if of and name not in taken:
            spoken.setdefault(of, []).append(name)
    if len(spoken) > MOST_GROUPS:
        return _StandIns(found.text, found.text)
    shown = {name for members in spoken.values() for name in members[:STAND_INS]}
    wide = [Group(tuple(each[:STAND_INS]), tuple(each), each=True) for each in spoken.values() if len(each) > STAND_INS]
    for number, each in enumerate(mentions):
        if each.each:
            names[number] = [name for name in order if name in each.robots and (name in taken or name in shown)]
    text = typed = found.text
    for number, each in reversed(list(enumerate(mentions))):
        if put := names.get(number):
            text = f"{text[: each.start]}{_joined(put)}{text[each.end :]}"
            if not each.each or each.parted or len(put) == 1:
                typed = f"{typed[: each.start]}{_joined(put)}{typed[each.end :]}"
    # Wide groups first: `whole` gives work to all before it looks for those who are able.
    return _StandIns(text, typed, frozenset(taken - named | shown), (*wide, *groups))


def _joined(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _mentions(found: Reading, order: Sequence[str], named: set[str], site: Site | None) -> list[_Mention]:
    """Return the mentions in whose place names can stand, as the words come."""
    mentions = [
        made
        for number, token in enumerate(found.tokens)
        if token.kind == "robot" and token.robots and not token.listed and not _names_place(found.text, token, site)
        if (made := _mention(found, number))
    ]
    if named:
        rest = frozenset(order) - named
        for match in _OTHERS.finditer(found.text):
            inside = any(each.start < match.end("who") and match.start("who") < each.end for each in mentions)
            mentions = [each for each in mentions if not match.start("who") <= each.start < match.end("who")]
            if rest and (not inside or match["who"].lower().startswith("every")):
                mentions.append(_Mention(match.start("who"), match.end("who"), rest, each=True, parted=True))
    return sorted(mentions, key=lambda each: each.start)


def _names_place(text: str, token: Token, site: Site | None) -> bool:
    """Whether a noun for robots begins the name of a place: "the drone pad"."""
    noun = token.text.rpartition(" ")[2]
    said = text[token.end - len(noun) :].casefold()
    names = [name for key, place in site.places.items() for name in (key, *place.aliases)] if site is not None else ()
    return any(name.startswith(f"{noun} ") and re.match(rf"{re.escape(name)}\b", said) for name in names)


def _mention(found: Reading, number: int) -> _Mention | None:
    token = found.tokens[number]
    before = found.tokens[number - 1].text if number else ""
    after = found.tokens[number + 1].text if number + 1 < len(found.tokens) else ""
    if before in NOT_DOING or (before in _TELLING and after != "to"):
        return None
    words = set(token.text.split())
    if token.group == "all" and not words & _EACH and before not in _STARTS:
        return None  # "move the units to dock 2": robots, or what they carry
    if token.group == "all" and token.count in (0, len(token.robots)):
        end, out = _excepted(found, number, token)
        return _Mention(token.start, end, frozenset(token.robots) - out, each=True, parted=bool(out))
    if token.group == "any" and 0 < token.count <= MOST_COUNTED and (words & _OTHER or not words & _ANYBODY):
        return _Mention(token.start, token.end, frozenset(token.robots), each=False, count=token.count)
    return None


def _excepted(found: Reading, number: int, token: Token) -> tuple[int, frozenset[str]]:
    """Return where a group ends, with the robots that are left out of it, and who they are."""
    link = _EXCEPT
    end, out = token.end, set[str]()
    for each in islice(found.tokens, number + 1, None):
        if each.kind != "robot" or each.group != "one":
            if each.kind == "robot" or each.start > end + 20:
                break
            continue
        if link.fullmatch(found.text[end : each.start]) is None:
            break
        out |= set(each.robots)
        end, link = each.end, _LINK
    return end, frozenset(out)


def _for_checks(roster: Sequence[RobotInfo], shown: set[str]) -> tuple[RobotInfo, ...]:
    """Return those who are shown and two of each combination of abilities, so that who could do a thing is known."""
    kept: dict[tuple[Any, ...], int] = {}
    found: list[RobotInfo] = []
    for each in roster:
        abilities = (each.uses, each.verbs, each.flies)
        if each.id in shown:
            found.append(each)
        elif kept.get(abilities, 0) < 2 and (abilities in kept or len(kept) < _MOST_ABILITIES):
            kept[abilities] = kept.get(abilities, 0) + 1
            found.append(each)
    return tuple(found)


# --- the plan for all -----------------------------------------------------------------------------------------------


def _given_to_all(plan: Plan, group: Group) -> Plan:
    """Return a plan in which every member does what all stand-ins do; the same plan where they do not do the same."""
    first, *others = group.shown
    rest = group.members[len(group.shown) :]
    parts = {name: [each for each in plan.subtasks if robots_of(each) == {name}] for name in group.shown}
    mine = {each.id: number for number, each in enumerate(parts[first])}
    for name in others:
        if not _alike(plan, parts[first], parts[name], {first: name}):
            return plan
    if any(set(group.shown) & robots_of(each) and not _jointly(each, group.shown) for each in plan.subtasks
           if robots_of(each) not in [{name} for name in group.shown]):  # fmt: skip
        return plan
    if not mine and not any(_jointly(each, group.shown) for each in plan.subtasks):
        return plan
    total = len(plan.subtasks) + len(mine) * len(rest)
    if total > MAX_SUBTASKS:
        text = (
            f"the instruction asks for {total} subtasks, {len(group.members)} robots doing the same, and "
            f"{MAX_SUBTASKS} is the most a plan may have"
        )
        raise PlanError(text, remedy=SPLIT, oversize=True)
    copies = {one: [f"{one}~{name}" for name in rest] for one in mine}
    subtasks: list[Subtask] = []
    last = {each.id: number for number, each in enumerate(parts[group.shown[-1]])}
    for each in plan.subtasks:
        own = robots_of(each)
        if len(own) == 1 and own <= set(group.shown):
            subtasks.append(each)
            if each.id in last:
                origin = parts[first][last[each.id]]
                subtasks += [_copy(origin, first, name, mine) for name in rest]
            continue
        after = [new for one in each.after for new in (one, *copies.get(one, ()))]
        widened = replace(each, after=tuple(after))
        subtasks.append(_with_all(widened, rest) if _jointly(each, group.shown) else widened)
    return _renumbered(replace(plan, subtasks=tuple(subtasks)))


def _copy(origin: Subtask, first: str, name: str, mine: Mapping[str, int]) -> Subtask:
    """Return a stand-in's subtask as another member's."""
    after = tuple(f"{one}~{name}" if one in mine else one for one in origin.after)
    return replace(_renamed(origin, {first: name}), id=f"{origin.id}~{name}", after=after)


def _alike(plan: Plan, one: Sequence[Subtask], other: Sequence[Subtask], names: Mapping[str, str]) -> bool:
    """Whether one stand-in's part of a plan is another's: skills, parameters, order, and who waits for it."""
    ids = {mine.id: theirs.id for mine, theirs in zip(one, other, strict=False)}
    if len(one) != len(other):
        return False
    for mine, theirs in zip(one, other, strict=True):
        after = {ids.get(each, each) for each in mine.after}
        if mine.skill != theirs.skill or after != set(theirs.after) or _renamed(mine, names).params != theirs.params:
            return False
    own = {*ids, *ids.values()}
    waiting = [set(each.after) for each in plan.subtasks if each.id not in own]
    return all((mine in after) == (theirs in after) for after in waiting for mine, theirs in ids.items())


def _jointly(subtask: Subtask, names: Iterable[str]) -> bool:
    """Whether a subtask is done by several robots together, these among them."""
    listed: object = subtask.params.get("robots")
    return isinstance(listed, list | tuple) and set(names) <= {str(each) for each in listed}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]


def _with_all(subtask: Subtask, rest: Sequence[str]) -> Subtask:
    listed: list[str] = list(subtask.params["robots"])
    return replace(
        subtask, params={**subtask.params, "robots": [*listed, *(each for each in rest if each not in listed)]}
    )


def _given_to_able(plan: Plan, group: Group, robots: Sequence[RobotInfo], catalogue: Catalogue) -> Plan:
    """Return a plan in which those of a kind who can do it, and are there, do what its stand-ins were given."""
    known = {each.id: each for each in robots}
    used = {name for each in plan.subtasks for name in robots_of(each)} - set(group.shown)
    chosen: dict[str, str] = {}
    for name in group.shown:
        given = [each for each in plan.subtasks if name in robots_of(each)]
        manifests = [m for each in given if (m := catalogue.skills.get(each.skill)) is not None]
        fitting = [
            other
            for other in group.members
            if other in known
            and other not in used
            and other not in chosen.values()
            and not any(able(known[other], manifest) for manifest in manifests)
        ]
        chosen[name] = min(fitting, key=lambda other: not known[other].online, default=name)
    if all(name == other for name, other in chosen.items()):
        return plan
    return replace(plan, subtasks=tuple(_renamed(each, chosen) for each in plan.subtasks))


def _renamed(subtask: Subtask, names: Mapping[str, str]) -> Subtask:
    def of(value: Any) -> Any:
        if isinstance(value, list):
            return [of(each) for each in value]  # pyright: ignore[reportUnknownVariableType]
        return names.get(value, value) if isinstance(value, str) else value

    robot = None if subtask.robot is None else names.get(subtask.robot, subtask.robot)
    return replace(subtask, robot=robot, params={key: of(value) for key, value in subtask.params.items()})


def _renumbered(plan: Plan) -> Plan:
    """Return a plan with the ids s1, s2, ... in the order of its subtasks."""
    place = {each.id: number for number, each in enumerate(plan.subtasks, start=1)}
    subtasks = tuple(
        replace(each, id=f"s{place[each.id]}", after=tuple(f"s{n}" for n in sorted(place[one] for one in each.after)))
        for each in plan.subtasks
    )
    return replace(plan, subtasks=subtasks)
