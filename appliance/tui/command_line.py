"""What is typed in the line at the bottom: after `:` an action with its arguments, completed; after `/` a filter.

A filter is a regular expression without regard to case; a leading `!` shows all the others. Pure.
"""

import difflib
import re
import warnings
from collections.abc import Callable, Iterable, Mapping

from msgspec import Struct

from appliance.alerts.rules import ordered
from appliance.errors import SwiftbotError
from appliance.learn import recipe as recipes
from appliance.model import Site
from appliance.model.schedules import ScheduleList
from appliance.operations import Argument, Operation
from appliance.tui.actions import ACTIONS
from appliance.tui.store import Store

LONGEST = 200
"""Characters of a filter."""
_NESTED = re.compile(r"[+*}]\??\)+\??(?:[+*]|\{\d*,)")
"""A repetition of what ends in a repetition: matching may take for ever, and the screen would stand still."""


class Filter:
    """A filter of lines of text.

    Args:
        text: as a person typed it. One that is no regular expression is looked for as it stands.
    """

    def __init__(self, text: str = "") -> None:
        self.text = text[:LONGEST]
        self.note = ""
        """Why it is not taken for a regular expression; empty when it is."""
        self.inverse = self.text.startswith("!")
        wanted = self.text[1:] if self.inverse else self.text
        self._wanted = wanted.casefold()
        self._pattern: re.Pattern[str] | None = None
        if not wanted:
            return
        if _NESTED.search(wanted):
            self.note = "repeats within repeats may take for ever; looked for as plain text"
            return
        try:
            with warnings.catch_warnings():
                # A person who filters a table has no use for warnings about future syntax.
                warnings.simplefilter("ignore", FutureWarning)
                self._pattern = re.compile(wanted, re.IGNORECASE)
        except (re.error, RecursionError, OverflowError) as error:
            self.note = f"no regular expression ({error}); looked for as plain text"

    def __bool__(self) -> bool:
        """Whether it hides anything."""
        return bool(self._wanted)

    def __eq__(self, other: object) -> bool:
        """Filters of the same text are the same."""
        return isinstance(other, Filter) and self.text == other.text

    def __hash__(self) -> int:
        """As `__eq__` has it."""
        return hash(self.text)

    def matches(self, line: str) -> bool:
        """Whether a line is to be shown."""
        if not self._wanted:
            return True
        found = self._pattern.search(line) is not None if self._pattern else self._wanted in line.casefold()
        return found is not self.inverse


MOST_HINTS = 40
"""Completions worked out at once."""


class UsageError(SwiftbotError):
    """A command line that means nothing; nothing was done."""

    code = "usage"


class Command(Struct, frozen=True):
    """An action with its arguments by kind; `missing` are required ones that are not given."""

    action: Operation
    given: dict[str, str]
    missing: tuple[Argument, ...] = ()


def words(line: str) -> list[str]:
    """Return the words of a line; quotes keep blanks in one, an open quote runs to the end."""
    found: list[str] = []
    word, quote, inside = "", "", False
    for character in line:
        if quote:
            if character == quote:
                quote = ""
            else:
                word += character
        elif character in "\"'" and not inside:
            quote, inside = character, True
        elif character.isspace():
            if inside:
                found.append(word)
            word, inside = "", False
        else:
            word, inside = word + character, True
    return [*found, word] if inside else found


def find(name: str, actions: Iterable[Operation] = ACTIONS) -> Operation:
    """Return the action of a name, or of the one name that begins so; UsageError when there is none or several."""
    by_name = {each: action for action in actions for each in (action.name, *action.aliases)}
    if name in by_name:
        return by_name[name]
    found = {action.name: action for each, action in by_name.items() if name and each.startswith(name)}
    if len(found) == 1:
        return next(iter(found.values()))
    if found:
        raise UsageError(f"`{name[:40]}` may be {', '.join(sorted(found))}", remedy="write more of it")
    near = difflib.get_close_matches(name, by_name, n=1)
    remedy = f"did you mean `{near[0]}`?" if near else "? lists all commands, Tab completes"
    raise UsageError(f"there is no command `{name[:40]}`", remedy=remedy)


def read(line: str, chosen: Mapping[str, str], actions: Iterable[Operation] = ACTIONS) -> Command:
    """Return what a command line means; arguments that are not written are taken from what is chosen on the screen.

    Args:
        line: what was typed after the colon.
        chosen: what is selected, by kind.
        actions: those there are.

    Raises:
        UsageError: no such command, or too many arguments.
    """
    typed = words(line)
    if not typed:
        raise UsageError("no command", remedy="write one; Tab completes, ? lists all")
    action = find(typed[0], actions)
    rest = typed[1:]
    given: dict[str, str] = {}
    for number, parameter in enumerate(action.takes):
        if parameter.rest:
            if number < len(rest):
                given[parameter.name] = _after(line, 1 + number)
            rest = rest[:number]
            break
        if number < len(rest):
            given[parameter.name] = rest[number]
    if len(rest) > len(action.takes):
        raise UsageError(f"`{action.name}` takes {len(action.takes)} arguments, not {len(rest)}", remedy=action.usage)
    return fill(action, given, chosen)


def fill(action: Operation, given: Mapping[str, str], chosen: Mapping[str, str]) -> Command:
    """Return an action with what was given and, for what must be there, what is chosen on the screen."""
    full = {key: value for key, value in given.items() if value}
    for parameter in action.takes:
        if parameter.name not in full and (not parameter.optional or parameter.chosen) and parameter.kind in chosen:
            full[parameter.name] = chosen[parameter.kind]
    missing = tuple(each for each in action.takes if not each.optional and each.name not in full)
    return Command(action, full, missing)


def _after(line: str, count: int) -> str:
    """Return what follows the first `count` words, as typed; quotes keep blanks in one of these words."""
    end, quote, inside = 0, "", False
    for at, character in enumerate(line):
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'" and not inside:
            quote, inside = character, True
        elif not character.isspace():
            inside = True
        elif inside:
            inside, count = False, count - 1
            if not count:
                end = at
                break
    else:
        return ""
    return line[end:].strip()


# --- completion --------------------------------------------------------------------------------------------


def candidates(kind: str, store: Store, names: Mapping[str, Iterable[str]]) -> list[str]:
    """Return values that an argument of a kind may have, as far as they are known.

    Args:
        kind: of a parameter.
        store: the fleet.
        names: further names by kind, such as themes.
    """
    known: Mapping[str, Callable[[], Iterable[str]]] = {
        "gateway": lambda: sorted(store.gateways),
        "robot": lambda: sorted(store.robots),
        "task": lambda: store.newest,
        "alert": lambda: (each.id for each in ordered(store.alerts.values())),
        "subtask": lambda: (
            f"{task}/{each.subtask.id}" for task in store.newest for each in store.tasks[task].subtasks
        ),
        "container": lambda: sorted(each.id for each in store.containers.values()),
        "schedule": lambda: [each.schedule.id for each in asked_schedules(store).schedules],
        "place": lambda: [f'"{name}"' if " " in name else name for name in asked_places(store)],
        "rule": lambda: [each.name for each in store.closures.values() if each.kind == "rule"],
        "run": lambda: sorted(store.runs, key=lambda name: -store.runs[name].started_ns),
        "recipe": recipes.built_in,
        "robots": lambda: ("all", *sorted(store.robots)),
        "client": lambda: sorted({each.name for run in store.runs.values() for each in run.clients}),
        "image": lambda: sorted({plain_image(each.image) for each in store.containers.values()}),
    }
    if kind in names:
        return list(names[kind])
    return list(known[kind]()) if kind in known else []


SCHEDULES, PLACES = "schedules", "places"
"""Under which the store keeps what was answered last."""


def asked_schedules(store: Store) -> ScheduleList:
    """Return the schedules as they were answered last."""
    known = store.asked.get(SCHEDULES)
    return known if isinstance(known, ScheduleList) else ScheduleList()


def asked_places(store: Store) -> list[str]:
    """Return the names of the site's places as they were answered last."""
    known = store.asked.get(PLACES)
    return sorted(known.places) if isinstance(known, Site) else []


def plain_image(reference: str) -> str:
    """Return an image's name without registry and tag, as commands take it."""
    return reference.rsplit("/", 1)[-1].split(":", 1)[0]


def complete(
    line: str, store: Store, names: Mapping[str, Iterable[str]], actions: Iterable[Operation] = ACTIONS
) -> tuple[str, ...]:
    """Return whole lines that go on from what was typed, at most `MOST_HINTS`."""
    typed = words(line)
    ended = not line or line[-1].isspace()
    if not typed or (len(typed) == 1 and not ended):
        begun = typed[0] if typed else ""
        found = sorted(each.name for each in actions if each.name.startswith(begun))
        return tuple(f"{name} " if find(name, actions).takes else name for name in found)[:MOST_HINTS]
    try:
        action = find(typed[0], actions)
    except UsageError:
        return ()
    number = len(typed) - (1 if ended else 2)
    if number >= len(action.takes) or action.takes[number].rest:
        return ()
    begun = "" if ended else typed[-1]
    stem = line if ended else line[: len(line) - len(begun)]
    values = candidates(action.takes[number].kind, store, names)
    starting = [each for each in values if each.startswith(begun)]
    containing = [each for each in values if begun in each and not each.startswith(begun)]
    return tuple(f"{stem}{each}" for each in (*starting, *containing))[:MOST_HINTS]
