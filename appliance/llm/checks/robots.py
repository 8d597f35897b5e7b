"""Checks of robots: a plan moves those that the words name or imply, and gives each what the words give it. Pure."""

from collections.abc import Iterable

from appliance.llm.checks import lexicon as lx
from appliance.llm.checks.facts import Facts
from appliance.llm.checks.reading import Token
from appliance.llm.checks.safety import robots_of
from appliance.llm.checks.schema import able, is_unnamed
from appliance.llm.checks.wording import forbidden
from appliance.model import Finding, Severity, Subtask

_NOT_SUBJECT = frozenset(
    (
        "to",
        "follow",
        "follows",
        "following",
        "towards",
        "toward",
        "behind",
        "beside",
        "near",
        "from",
        "at",
        "meet",
        "around",
    )
)
"""Words before a robot that is no subject: "give the box to rover_2"."""
_ELLIPSIS = frozenset(("does", "do", "same", "likewise", "too"))
"""Words that give another robot what was said before: "rover_1 goes to dock 3 while rover_2 does"."""
_JOIN = frozenset((",", "and", "&", "plus"))
_INSTRUMENT = frozenset(("with", "using", "by", "via", "have", "let", "send", "get", "tell", "ask", "make"))


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
    """No robot is told to fly that does not fly."""
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
    governs = _governors(facts)
    if not any(governs) or any(each.text in _ELLIPSIS for each in facts.reading.tokens):
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
    governs = _governors(facts)
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


def _governors(facts: Facts) -> list[frozenset[str]]:
    """For each token the robots that may be its subject; empty where none was named."""
    tokens = facts.reading.tokens
    values = set[int]().union(*facts.account.values.values()) if facts.account.values else set[int]()
    subjects: list[tuple[int, int, frozenset[str]]] = []
    number = 0
    while number < len(tokens):
        if not _subject(tokens, number, values):
            number += 1
            continue
        first, last, robots = number, number, set(tokens[number].robots)
        while True:
            step = last + 1
            while step < len(tokens) and tokens[step].text in _JOIN:
                step += 1
            if step == last + 1 or step >= len(tokens) or tokens[step].kind != "robot" or step in values:
                break
            robots |= set(tokens[step].robots)
            last = step
        subjects.append((first, last, frozenset(robots)))
        number = last + 1
    found: list[frozenset[str]] = []
    for index in range(len(tokens)):
        earlier = [robots for _, last, robots in subjects if last <= index]
        sentence = facts.reading.sentence[index]
        later = [
            (first, robots)
            for first, _, robots in subjects
            if first > index and facts.reading.sentence[first] == sentence
        ]
        meant = set(earlier[-1]) if earlier else set[str]()
        if later and (not earlier or _trails(tokens, later[0][0])):
            meant |= later[0][1]
        found.append(frozenset(meant))
    return found


def _subject(tokens: tuple[Token, ...], number: int, values: set[int]) -> bool:
    if tokens[number].kind != "robot" or number in values or not tokens[number].robots:
        return False
    before = number - 1
    while before >= 0 and tokens[before].text in ("the", "our", "my"):
        before -= 1
    return before < 0 or tokens[before].text not in _NOT_SUBJECT


def _trails(tokens: tuple[Token, ...], first: int) -> bool:
    """Whether a mention names who does what stands before it: at the end of its sentence, or after "with"."""
    if first and tokens[first - 1].text in ("with", "using", "by", "via"):
        return True
    after = tokens[first + 1].text if first + 1 < len(tokens) else "."
    return after in (".", "!", "?", ";", "\n")
