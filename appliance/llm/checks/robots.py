"""Checks of robots: a plan moves those that the words name or imply, and gives each what the words give it. Pure."""

from collections.abc import Iterable

from appliance.llm.checks import lexicon as lx
from appliance.llm.checks.facts import Facts
from appliance.llm.checks.safety import robots_of
from appliance.llm.checks.schema import able, is_unnamed
from appliance.llm.checks.wording import forbidden, side_by_side
from appliance.model import Finding, Severity, Subtask

_ELLIPSIS = frozenset(("does", "do", "same", "likewise", "too"))
"""Words that give another robot what was said before: "rover_1 goes to dock 3 while rover_2 does"."""


def candidates(facts: Facts, name: str) -> list[str]:
    """Return the robots of the roster that can do all that a plan gives one name."""
    manifests = [
        m for each in facts.plan.subtasks if name in robots_of(each) and (m := facts.manifest(each)) is not None
    ]
    return sorted(each.id for each in facts.robots or () if not any(able(each, m) for m in manifests))


def unnamed_robot(facts: Facts) -> Iterable[Finding]:
    """A plan moves no robot that the words neither name nor imply, where they name any."""
    if facts.robots is None or facts.continued:
        return
    named = facts.reading.named
    loose = any(each.group == "any" for each in facts.reading.tokens)
    for robot in _planned(facts):
        if is_unnamed(robot) or robot in named or robot == "all" or not named or loose:
            continue
        if candidates(facts, robot) == [robot] and not _covered_by_named(facts, robot):
            continue
        yield Finding(
            check="unnamed_robot", severity=Severity.HOLD,
            message=f"the plan uses {robot}, which the words do not name", hint="name each robot",
        )  # fmt: skip


def choose_robot(facts: Facts) -> Iterable[Finding]:
    """Where several robots can do what is asked of none by name, a person chooses (`safety.choose_robot`)."""
    if facts.robots is None or facts.continued or facts.safety.choose_robot != "ask":
        return
    named = facts.reading.named
    loose = any(each.group == "any" for each in facts.reading.tokens)
    for robot in _planned(facts):
        if robot in named or robot == "all" or (named and not loose and not is_unnamed(robot)):
            continue
        able = candidates(facts, robot)
        if len(able) > 1:
            yield Finding(
                check="choose_robot", severity=Severity.HOLD,
                message=f"several robots can do this, and none is named: {', '.join(able[:8])}",
                hint='name the robot, or set safety.choose_robot = "auto"',
            )  # fmt: skip
            return


def _planned(facts: Facts) -> list[str]:
    return list(dict.fromkeys(robot for each in facts.plan.subtasks for robot in sorted(robots_of(each))))


def _covered_by_named(facts: Facts, robot: str) -> bool:
    """Whether a robot that the words name could do all that the plan gives to this one."""
    manifests = [
        m for each in facts.plan.subtasks if robot in robots_of(each) and (m := facts.manifest(each)) is not None
    ]
    return any(
        each.id in facts.reading.named and not any(able(each, m) for m in manifests) for each in facts.robots or ()
    )


def flies(facts: Facts) -> Iterable[Finding]:
    """No robot gets an order to fly that does not fly."""
    flying = {each.id: each.flies for each in facts.robots or ()}
    tokens = facts.reading.tokens
    for number, token in enumerate(tokens[1:], start=1):
        before = tokens[number - 1]
        if token.text in _FLY and before.kind == "robot" and any(not flying.get(each, True) for each in before.robots):
            who = ", ".join(each for each in before.robots if not flying.get(each, True))
            yield Finding(
                check="capability", severity=Severity.HOLD, words=(token.text,),
                message=f'"{token.text}": {who} does not fly',
            )  # fmt: skip
            return


_FLY = frozenset(("fly", "flies", "flying", "hover", "hovers", "soar", "soars"))


def idle_robot(facts: Facts) -> Iterable[Finding]:
    """Each robot that the words name has something to do."""
    if facts.continued:
        return
    busy = {robot for each in facts.plan.subtasks for robot in robots_of(each)}
    values = set[int]().union(*facts.account.values.values()) if facts.account.values else set[int]()
    skip = values | forbidden(facts)
    quoted = any(each.kind == "quote" for each in facts.reading.tokens)
    manifests = [None if each.robot is not None else facts.manifest(each) for each in facts.plan.subtasks]
    if quoted and all(each is not None and each.reports for each in manifests):
        return  # the gateway passes on what stands in quotation marks, whichever robot is addressed
    idle = {
        robot
        for number, each in enumerate(facts.reading.tokens)
        if each.kind == "robot" and each.group in ("one", "all") and number not in skip
        for robot in each.robots
    } - busy
    if idle and "all" not in busy and not any(is_unnamed(each) for each in busy):
        names = ", ".join(sorted(idle))
        yield Finding(
            check="idle_robot",
            severity=Severity.HOLD,
            message=f"{names} is named and has nothing to do",
            words=tuple(sorted(idle)),
        )


def assignment(facts: Facts) -> Iterable[Finding]:
    """Each robot does what the words give to it, not what they give to another."""
    if facts.continued:
        return
    governs = facts.governors
    if not any(governs) or any(_elliptic(facts, number) for number in range(len(facts.reading.tokens))):
        return
    for subtask in facts.plan.subtasks:
        robot = subtask.robot
        if robot is None or robot == "all" or is_unnamed(robot) or subtask.id in facts.added:
            continue
        values, called = facts.account.values[subtask.id], facts.account.called[subtask.id]
        at = values or called
        if any(facts.reading.tokens[index].text in lx.PRONOUNS for index in range(len(facts.reading.tokens))):
            at = values | called  # "while the drone films it": the thing was said before, of another
        meant = [governs[index] for index in at if governs[index] and _of_verb(facts, subtask, robot, index)]
        own = [governs[index] for index in values if governs[index]]
        if own and robot not in set[str]().union(*own) and _it_follows(facts, called):
            yield Finding(
                check="assignment", severity=Severity.HOLD,
                message=f"{subtask.id} ({subtask.skill}): it is not clear what is meant by the pronoun",
            )  # fmt: skip
            continue
        there = [governs[index] for index in at if governs[index]]
        if there and not any(robot in each for each in meant):
            who = ", ".join(sorted(set[str]().union(*there) - {robot})) or "another"
            yield Finding(
                check="assignment", severity=Severity.HOLD,
                message=f"{subtask.id} ({subtask.skill}) is given to {robot}, and the words give it to {who}",
            )  # fmt: skip


def _elliptic(facts: Facts, number: int) -> bool:
    """Whether a word gives the robot before it what was said of another: nothing of its own is said between."""
    tokens = facts.reading.tokens
    if tokens[number].text not in _ELLIPSIS or side_by_side(tokens, number + 1):
        return False
    robot = next((each for each in range(number, -1, -1) if tokens[each].kind == "robot"), -1)
    said = facts.account.values.values()
    return not any(robot < index < number for each in said for index in each)


def _of_verb(facts: Facts, subtask: Subtask, robot: str, index: int) -> bool:
    """Whether a word that says a value goes with the subtask's own verb: the last one behind the robot's name, if any.

    "rover_2 opens the gate, then rover_1 drives to the gate": the second gate is nothing that rover_1 opens.
    """
    called = facts.account.called
    if index in called[subtask.id] or subtask.skill == "goto" or not called[subtask.id]:
        return True
    named = max(
        (
            n
            for n, each in enumerate(facts.reading.tokens[: index + 1])
            if each.kind == "robot" and robot in each.robots
        ),
        default=-1,
    )
    verbs = [each for found in called.values() for each in found if named < each < index] if named >= 0 else []
    return not verbs or max(verbs) in called[subtask.id] or any(each in called[subtask.id] for each in verbs)


def _it_follows(facts: Facts, called: set[int]) -> bool:
    """Whether a pronoun is the object of a verb: "films it"."""
    tokens = facts.reading.tokens
    return any(index + 1 < len(tokens) and tokens[index + 1].text in ("it", "them") for index in called)


def each_of_group(facts: Facts) -> Iterable[Finding]:
    """What is asked of several robots together is done by each of them."""
    if facts.continued or any(each.text in _DIVIDED for each in facts.reading.tokens):
        return
    governs = facts.governors
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        if manifest is None or manifest.joint or subtask.robot is None or subtask.id in facts.added:
            continue
        values, called = facts.account.values[subtask.id], facts.account.called[subtask.id]
        groups: list[frozenset[str]] = [governs[index] for index in values or called if len(governs[index]) > 1]
        if not groups or len(groups) < len([index for index in values or called if governs[index]]):
            continue
        doing = {
            each.robot for each in facts.plan.subtasks if each.skill == subtask.skill and each.params == subtask.params
        }
        asked = groups[0].intersection(*groups[1:])
        if lacking := sorted(asked - doing):
            yield Finding(
                check="assignment", severity=Severity.HOLD,
                message=f"{subtask.id} ({subtask.skill}) is asked of {', '.join(lacking)} too",
            )  # fmt: skip
            return


_DIVIDED = frozenset(("one", "other", "respectively", "between", "another", "different", "first", "second"))
"""Words by which each robot of several has a job of its own."""


def group_size(facts: Facts) -> Iterable[Finding]:
    """As many robots as the words say: "both drones" are two, "all four" are four, "a drone" is one."""
    if facts.robots is None or facts.continued:
        return
    tokens = facts.reading.tokens
    for each, link, end in zip(tokens, tokens[1:], tokens[2:], strict=False):
        if each.group == "all" and link.text in _RANGE and end.group == "one" and set(end.robots) <= set(each.robots):
            words = f"{each.text} {link.text} {end.text}"
            yield Finding(
                check="quantity", severity=Severity.HOLD, words=(words,),
                message=f'"{words}" may mean some of them', hint="name each robot",
            )  # fmt: skip
            return
    for each in tokens:
        state = _STATES.intersection(each.text.split())
        if each.kind != "robot" or len(each.robots) < 2 or not state:
            continue
        # One that is free is what placement takes; one that is near is not, and of several each is commanded.
        if each.group == "all" or not _FREE.issuperset(state):
            yield Finding(
                check="quantity", severity=Severity.HOLD, words=(each.text,),
                message=f'"{each.text}": which robots they are is known only when the plan runs',
                hint="name each robot; swiftbot robots shows where they are and what they do",
            )  # fmt: skip
            return
    mentions = [each for each in tokens if each.kind == "robot" and each.robots and each.count]
    for each in mentions:
        if each.group == "all" and not each.listed and len(each.robots) != each.count:
            yield Finding(
                check="quantity", severity=Severity.HOLD, words=(each.text,),
                message=f'"{each.text}": the fleet has {len(each.robots)} of them', hint="name each robot",
            )  # fmt: skip
            return
    named = facts.reading.named
    for meant in dict.fromkeys(each.robots for each in mentions if each.group == "any"):
        most = sum(each.count for each in mentions if each.group == "any" and set(each.robots) & set(meant))
        doing = [each for each in _planned(facts) if each in meant and each not in named]
        if len(doing) > most:
            text = next(each.text for each in mentions if each.robots == meant)
            yield Finding(
                check="quantity", severity=Severity.HOLD, words=(text,),
                message=f'"{text}": the plan has {len(doing)} of them do it: {", ".join(doing[:8])}',
                hint="name each robot",
            )  # fmt: skip
            return


_FREE = frozenset(("available", "free", "idle"))
_STATES = _FREE | {"nearest", "closest"}
"""Words that choose robots by what they do or where they are."""
_RANGE = frozenset(("from", "to", "through", "thru", "until", "till"))
"""Words between a group and the robots with which a part of it begins or ends: "all drones from drone_2 to drone_4"."""
