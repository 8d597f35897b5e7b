"""Completion in shells: `swiftbot completion bash|zsh|fish`, with the names of the fleet as it is.

The script that it prints asks the same command what may follow, given the words so far: commands and options out of the
command line itself, and names of robots, gateways, tasks, alerts and places out of the fleet, as far as that answers in
a second. Where nothing is known the shell completes files.
"""

import asyncio
import contextlib
import inspect
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import Field, fields, is_dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

from cyclopts import App, Parameter
from msgspec import Struct

from appliance.cli.common import HERE, TOOLS, Where
from appliance.client import FleetClient
from appliance.errors import Exit, SwiftbotError

ANSWER_S = 1.0
"""How long the fleet is waited for: somebody has pressed a key."""
MOST = 200
_SCRIPTS = {
    "bash": """_swiftbot() {
    local IFS=$'\\n' word
    COMPREPLY=()
    for word in $(swiftbot completion bash -- "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null); do
        COMPREPLY+=("$(printf %q "$word")")
    done
}
complete -o default -F _swiftbot swiftbot
""",
    "zsh": """#compdef swiftbot
_swiftbot() {
    local -a found
    found=("${(@f)$(swiftbot completion zsh -- "${(@)words[2,CURRENT]}" 2>/dev/null)}")
    [[ -n "$found" ]] && compadd -a found || _files
}
compdef _swiftbot swiftbot
""",
    "fish": """function _swiftbot
    swiftbot completion fish -- (commandline -opc)[2..] (commandline -ct) 2>/dev/null
end
complete -c swiftbot -a '(_swiftbot)'
""",
}
_KINDS = {
    "task": "task", "before": "task", "subtask": "task", "robot": "robot", "robots": "robot", "gateway": "gateway",
    "group": "gateway", "to": "gateway", "alert": "alert", "alerts": "alert", "container": "container",
    "question": "question", "text": "words", "schedule": "schedule", "instruction": "words",
    "place": "place",
}  # fmt: skip
"""What an argument of a name is, where the fleet knows its values."""


def add_to(app: App) -> None:
    """Add this command."""

    async def completion(
        shell: Literal["bash", "zsh", "fish"],
        /,
        *words: Annotated[str, Parameter(allow_leading_hyphen=True, help="Words so far: print what may follow.")],
        where: Where = HERE,
    ) -> int:
        """Print the completion script of a shell; put it where the shell reads it (docs/operations.md).

        Args:
            shell: Which shell.
        """
        if not words:
            print(_SCRIPTS[shell], end="")
            return Exit.DONE
        offer = offers(app, words)
        found = list(offer.words)
        if offer.kind:
            found += await _names(offer.kind, where)
        for each in dict.fromkeys(found):
            if each.startswith(words[-1]) and "\n" not in each:
                print(each)
        return Exit.DONE

    app.command(completion, group=TOOLS)


class Offer(Struct, frozen=True):
    """What may follow: words that are known, and the kind of names of which the fleet knows some."""

    words: tuple[str, ...] = ()
    kind: str = ""


def offers(app: App, words: Sequence[str]) -> Offer:
    """Return what may stand in the place of the last word. Pure.

    Args:
        app: the command line.
        words: after the program's name; the last is being written and may be empty.
    """
    *before, begun = words
    found = app
    given = 0
    option: inspect.Parameter | None = None
    for word in before:
        if option is not None:
            option = None
        elif word.startswith("-"):
            option = _options(found).get(word)
            if option is not None and _type(option) is bool:
                option = None
        elif not given and word in found and not word.startswith("-"):
            found = found[word]
        else:
            given += 1
    if option is not None:
        return _values(option)
    if begun.startswith("-"):
        return Offer(tuple(sorted({*_options(found), "--help"})))
    commands = () if given else tuple(name for name in found if not name.startswith("-"))
    if found.default_command is None or found is app:
        return Offer(commands)
    positional = [each for each in _parameters(found) if each.kind is not each.KEYWORD_ONLY]
    place = positional[min(given, len(positional) - 1)] if positional else None
    if place is None or (given >= len(positional) and place.kind is not place.VAR_POSITIONAL):
        return Offer(commands)
    offer = _values(place)
    return Offer((*commands, *offer.words), offer.kind)


def _parameters(command: App) -> list[inspect.Parameter]:
    if command.default_command is None:
        return []
    return list(inspect.signature(command.default_command).parameters.values())


def _type(parameter: inspect.Parameter) -> Any:
    annotation = parameter.annotation
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _options(command: App) -> dict[str, inspect.Parameter]:
    """Return the options of a command, by each of their names."""
    found: dict[str, inspect.Parameter] = {}
    for each in _parameters(command):
        if each.kind is not each.KEYWORD_ONLY:
            continue
        if _type(each) is Where:
            found |= dict.fromkeys(("--fleet", "--dir", "--connect"), each)
            continue
        if is_dataclass(kind := _type(each)):
            found |= {f"--{field.name.replace('_', '-')}": _of(field) for field in fields(kind)}
            continue
        extra = get_args(each.annotation)[1:] if get_origin(each.annotation) is Annotated else ()
        own = next((one.name for one in extra if getattr(one, "name", None)), ())
        for name in own or (f"--{each.name.replace('_', '-')}",):
            found[name] = each
    return found


def _of(field: Field[Any]) -> inspect.Parameter:
    """Return a field of a group of options as a parameter."""
    return inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, annotation=field.type)


def _values(parameter: inspect.Parameter) -> Offer:
    """Return what an argument or option may be."""
    kind = _type(parameter)
    if get_origin(kind) is Literal:
        return Offer(tuple(map(str, get_args(kind))))
    return Offer(kind=_KINDS.get(parameter.name, ""))


async def _names(kind: str, where: Where) -> list[str]:
    """Return the names of a kind that the fleet knows; none where it does not answer in time."""

    async def words(client: FleetClient) -> list[str]:
        site = await client.site()
        return [*sorted(client.plane.registry.robots), *sorted(site.places)]

    async def known(client: FleetClient, names: Callable[[FleetClient], Sequence[str]]) -> list[str]:
        await asyncio.sleep(0.1)  # what robots and gateways say of themselves comes a moment after the link
        return sorted(names(client))

    asked: Mapping[str, Callable[[FleetClient], Awaitable[list[str]]]] = {
        "task": _tasks,
        "alert": _alerts,
        "question": _questions,
        "schedule": _schedules,
        "place": _places,
        "words": words,
        "robot": lambda client: known(client, lambda each: list(each.plane.registry.robots)),
        "gateway": lambda client: known(client, lambda each: list(each.plane.members())),
        "container": lambda client: known(
            client, lambda each: [name for held in each.plane.registry.containers.values() for name in held]
        ),
    }
    with contextlib.suppress(SwiftbotError, TimeoutError):
        async with asyncio.timeout(ANSWER_S), where.client() as client:
            await client.gateway()
            return (await asked[kind](client))[:MOST]
    return []


async def _tasks(client: FleetClient) -> list[str]:
    return [each.id for each in (await client.tasks(50)).tasks]


async def _alerts(client: FleetClient) -> list[str]:
    return [each.id for each in (await client.alerts()).alerts]


async def _places(client: FleetClient) -> list[str]:
    return sorted((await client.site()).places)


async def _schedules(client: FleetClient) -> list[str]:
    return [each.schedule.id for each in (await client.schedules()).schedules]


async def _questions(client: FleetClient) -> list[str]:
    return [each.id for each in (await client.enquiries()).enquiries]
