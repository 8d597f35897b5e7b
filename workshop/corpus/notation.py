"""The notation of `.plan` files: an instruction, then its plan, a line for each subtask.

    # a comment
    = hand-1

    > Rex, fetch the drill from bay 2.
    ~ foreman
    @ rex max
    manipulation
    s1 rex goto place="bay 2"
    s2 rex pick object="drill" < s1

A line `= TAG` on its own names the source of the pairs below it, up to the next such line. `>` lines are the
instruction (several for several lines), `~` names the voice, `@` the roster, where one is known. Then the domain, and
subtasks: id, robot (`-` for none), skill, parameters as name=JSON value, and after `<` the direct predecessors. An
instruction that no plan answers has, in place of all that, `none KIND: why`. A blank line ends a pair.

It is a bijection with `Pair`: what `write` writes, `parse` reads as the same pair, and nothing else is accepted.
"""

import json
import re
from collections.abc import Iterable
from typing import Any, NoReturn

import msgspec
from msgspec import Struct

from appliance.errors import PayloadError
from appliance.model import Subtask

KINDS = ("chatter", "question", "impossible", "unclear", "language")
"""Why an instruction has no plan: no order in it; asks what no robot can find out; no skill does it; it does not say
what to do; not in a language the planner knows."""

_ID = re.compile(r"s[1-9][0-9]?")
_SKILL = re.compile(r"[a-z][a-z0-9_]*")
_ROBOT = re.compile(r"[a-z0-9][a-z0-9_.-]*|-")
_VOICE = re.compile(r"[a-z]+")
_SOURCE = re.compile(r"= ?([a-z0-9-]*)")
_NONE = re.compile(rf"none ({'|'.join(KINDS)}): (\S.*)")
_HEAD = re.compile(r"(\S+) (\S+) (\S+)(.*)")
_PARAM = re.compile(r" ([a-z][a-z0-9_]*)=")
_AFTER = re.compile(r" <((?: \S+)+)")
_DECODER = json.JSONDecoder()


class Pair(Struct, frozen=True, kw_only=True):
    """An instruction with its plan, or with the reason why there is none."""

    instruction: str
    voice: str = "plain"
    """Who speaks, and how: farmer, radio, transcript, ..."""
    robots: tuple[str, ...] = ()
    """The roster known when the instruction arrived; empty when unknown."""
    domain: str = ""
    """Empty when there is no plan."""
    subtasks: tuple[Subtask, ...] = ()
    refused: str = ""
    """One of `KINDS` when there is no plan."""
    reason: str = ""
    """Why there is none, for the person who asked."""
    source: str = ""
    """Tag of where the pair comes from (README.md lists them); empty when unknown."""


def parse(text: str, *, name: str = "corpus") -> dict[int, Pair]:
    """Return the pairs of a file by the line they begin on.

    Args:
        text: contents of a `.plan` file.
        name: what errors call it.

    Raises:
        PayloadError: naming the first line that is not in the notation, and what is wrong with it.
    """
    pairs: dict[int, Pair] = {}
    block: list[tuple[int, str]] = []
    source = ""
    for number, line in enumerate([*text.split("\n"), ""], start=1):
        if line.startswith("#"):
            continue
        if line:
            block.append((number, line))
        elif block:
            if len(block) == 1 and (tag := _SOURCE.fullmatch(block[0][1])):
                source = tag[1]
            else:
                pairs[block[0][0]] = _Block(name, block).pair(source)
            block = []
    return pairs


def write(pairs: Iterable[Pair]) -> str:
    """Return pairs in the notation, a blank line between them, and a source line wherever the source changes."""
    blocks: list[str] = []
    source = ""
    for pair in pairs:
        if pair.source != source:
            source = pair.source
            blocks.append(f"= {source}\n" if source else "=\n")
        blocks.append(_written(pair))
    return "\n".join(blocks)


def _written(pair: Pair) -> str:
    lines = [f"> {line}" if line else ">" for line in pair.instruction.split("\n")]
    if pair.voice != "plain":
        lines.append(f"~ {pair.voice}")
    if pair.robots:
        lines.append(f"@ {' '.join(pair.robots)}")
    if pair.refused:
        lines.append(f"none {pair.refused}: {pair.reason}")
    else:
        lines.append(pair.domain)
        lines += [_subtask(subtask) for subtask in pair.subtasks]
    return "\n".join(lines) + "\n"


def _subtask(subtask: Subtask) -> str:
    params = "".join(f" {name}={json.dumps(value, ensure_ascii=False)}" for name, value in subtask.params.items())
    after = f" < {' '.join(subtask.after)}" if subtask.after else ""
    return f"{subtask.id} {subtask.robot or '-'} {subtask.skill}{params}{after}"


class _Block:
    """The lines of one pair, taken one by one."""

    def __init__(self, name: str, lines: list[tuple[int, str]]) -> None:
        self._name = name
        self._lines = lines
        self._at = 0

    def pair(self, source: str) -> Pair:
        instruction = "\n".join(self._run(">"))
        if not instruction.strip():
            self._fail("a pair begins with its instruction: > text")
        if instruction != instruction.strip():
            self._fail("the instruction begins or ends with blanks")
        voice = self._one("~", _VOICE, "a voice is one lower-case word") or "plain"
        robots = tuple(self._one("@").split()) if self._peek().startswith("@ ") else ()
        if any(not _ROBOT.fullmatch(robot) or robot == "-" for robot in robots):
            self._at -= 1
            self._fail("a roster is robot names with blanks between them")
        pair = Pair(instruction=instruction, voice=voice, robots=robots, source=source)
        head = self._peek()
        if match := _NONE.fullmatch(head):
            self._at += 1
            if self._peek():
                self._fail("nothing follows a refusal")
            return msgspec.structs.replace(pair, refused=match[1], reason=match[2])
        if head.startswith("none"):
            self._fail(f"a refusal is: none KIND: why, with KIND one of {', '.join(KINDS)}")
        if not _VOICE.fullmatch(head):
            self._fail("expected the plan's domain, or none KIND: why")
        self._at += 1
        subtasks: list[Subtask] = []
        while self._peek():
            subtasks.append(self._subtask(self._peek()))
            self._at += 1
        if not subtasks:
            self._fail("the plan has no subtask: give one, or refuse with none KIND: why")
        return msgspec.structs.replace(pair, domain=head, subtasks=tuple(subtasks))

    def _subtask(self, line: str) -> Subtask:
        head = _HEAD.fullmatch(line)
        if head is None:
            self._fail("a subtask is: id robot skill name=value ... < predecessors")
        name, robot, skill, rest = head.groups()
        for text, form in ((name, _ID), (robot, _ROBOT), (skill, _SKILL)):
            if not form.fullmatch(text):
                self._fail(f"{text!r} is not allowed there: a subtask is id robot skill name=value ... < predecessors")
        params: dict[str, Any] = {}
        while match := _PARAM.match(rest):
            try:
                value, end = _DECODER.raw_decode(rest, match.end())
            except ValueError:
                self._fail(f"the value of {match[1]} is not JSON: text stands in double quotes")
            if match[1] in params:
                self._fail(f"parameter {match[1]} stands twice")
            params[match[1]] = value
            rest = rest[end:]
        after: tuple[str, ...] = ()
        if match := _AFTER.fullmatch(rest):
            after = tuple(match[1].split())
        elif rest:
            self._fail(f"not understood: {rest.strip()!r}")
        if any(not _ID.fullmatch(other) for other in after):
            self._fail("predecessors are subtask ids, s1, s2, ...")
        return Subtask(id=name, skill=skill, robot=None if robot == "-" else robot, params=params, after=after)

    def _peek(self) -> str:
        return self._lines[self._at][1] if self._at < len(self._lines) else ""

    def _run(self, mark: str) -> Iterable[str]:
        while self._peek() == mark or self._peek().startswith(f"{mark} "):
            yield self._peek()[2:]
            self._at += 1

    def _one(self, mark: str, form: re.Pattern[str] | None = None, rule: str = "") -> str:
        line = self._peek()
        if not line.startswith(f"{mark} "):
            return ""
        if form is not None and not form.fullmatch(line[2:]):
            self._fail(rule)
        self._at += 1
        return line[2:]

    def _fail(self, why: str) -> NoReturn:
        number = self._lines[min(self._at, len(self._lines) - 1)][0]
        raise PayloadError(f"{self._name}:{number}: {why}", remedy="workshop/corpus/README.md has the notation")
