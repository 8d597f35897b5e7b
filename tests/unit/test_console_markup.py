"""Text of users and robots is printed as it is: brackets are no markup, colons no emoji, whatever table it is in."""

import types
from collections.abc import Callable, Mapping
from enum import Enum
from io import StringIO
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import Struct
from rich.text import Text

from appliance import cli, console, reasons
from appliance.cli import common, plane, robots, rules
from appliance.client import Stopped
from appliance.console import SafeConsole, analysis_text, experience_table, provenance_text, revision_lines, stream_line
from appliance.errors import RefusedError
from appliance.model import (
    Act,
    ContainerInfo,
    Enquiry,
    GatewayStatus,
    Lease,
    Provenance,
    RobotInfo,
    SoftStop,
    TaskRecord,
    Word,
)
from appliance.model.closures import Closure, Rule
from appliance.model.plane_api import Record, RecordPlace
from appliance.model.planner_api import Analysis
from appliance.model.pool_api import Evicted, PoolDecision
from appliance.model.robot_api import LinkList, StopAnswer
from appliance.model.task_api import ExperienceList, Line, PlanAnswer, TaskWhy
from appliance.pool.images import ImageState
from appliance.records import Held

CRASHES = '[/red] x" [bold]b[/] [link=x] [/] \\[a] :warning: [@click=f]'


def filled(kind: Any, text: str, depth: int = 0) -> Any:
    """Return a value of a type, with a text in every place that takes one, and numbers within their bounds."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        value = filled(arguments[0], text, depth)
        for meta in arguments[1:]:
            if isinstance(meta, msgspec.Meta) and type(value) in (int, float):
                value = bounded(value, meta)
        return value
    if origin in (Union, types.UnionType):
        return filled(next(each for each in arguments if each is not type(None)), text, depth)
    if origin is Literal:
        return arguments[0]
    if origin in (tuple, list, frozenset, dict, Mapping):
        return filled_many(origin, arguments, text, depth + 1)
    if kind is Closure:  # of its fields not all go together
        return Closure(kind="place", name=text, by=filled(Word, text))
    if isinstance(kind, type) and issubclass(kind, Struct):
        hints = get_type_hints(kind, include_extras=True)
        return kind(**{name: filled(hints[name], text, depth + 1) for name in kind.__struct_fields__})
    if isinstance(kind, type) and issubclass(kind, Enum):
        return next(iter(kind))
    plain: dict[Any, Any] = {bool: True, int: 1, float: 1.0, bytes: text.encode(), msgspec.Raw: msgspec.Raw(b"1")}
    return plain.get(kind, text)


def filled_many(origin: Any, arguments: tuple[Any, ...], text: str, depth: int) -> Any:
    """Return a collection with one value; a tuple of so many values with all of them."""
    if origin in (dict, Mapping):
        return {filled(arguments[0], text, depth): filled(arguments[1], text, depth)}
    if origin is tuple and Ellipsis not in arguments:
        return cast("Any", tuple(filled(each, text, depth) for each in arguments))
    if depth > 9:
        return cast("Any", ())
    return origin([filled(arguments[0], text, depth)])  # pyright: ignore[reportUnknownVariableType]


def bounded(value: float, meta: msgspec.Meta) -> float:
    """Return a number if it is within bounds, else one of its type that is."""
    step = 1 if type(value) is int else 2**-10
    below = [bound for bound in (meta.le, None if meta.lt is None else meta.lt - step) if bound is not None]
    above = [bound for bound in (meta.ge, None if meta.gt is None else meta.gt + step) if bound is not None]
    return type(value)(max([min([value, *below]), *above]))


def of(kind: Any, show: Callable[[Any], Any]) -> Callable[[str], Any]:
    """Return what makes a table of a filled value."""
    return lambda text: show(filled(kind, text))


def a_rule(text: str) -> Closure:
    """Return a standing rule with a text in all its names."""
    rule = Rule(robots=(text,), places=(text,), days=(0,), zone=text)
    return Closure(kind="rule", name=text, by=filled(Word, text), rule=rule)


SHOWN: dict[str, Callable[[str], Any]] = {
    "task": of(TaskRecord, console.task_table),
    "tasks": of(tuple[TaskRecord, ...], console.task_list),
    "held": of(TaskRecord, console.held_text),
    "revisions": of(TaskRecord, lambda record: console.Group(*revision_lines(record))),
    "progress": of(TaskRecord, lambda record: console.progress_line(record.subtasks[0])),
    "plan": of(PlanAnswer, console.plan_answer),
    "provenance": of(Provenance, provenance_text),
    "analysis": of(Analysis, analysis_text),
    "experience": of(ExperienceList, experience_table),
    "why": of(TaskWhy, reasons.why_text),
    "line": of(Line, stream_line),
    "gateways": of(tuple[GatewayStatus, ...], console.gateway_table),
    "containers": of(tuple[ContainerInfo, ...], console.container_table),
    "decisions": lambda text: console.decision_table([(text, filled(PoolDecision, text))]),
    "evicted": of(dict[str, Evicted], console.evicted_text),
    "images": of(tuple[ImageState, ...], console.image_table),
    "robots": of(tuple[RobotInfo, ...], console.robot_table),
    "links": of(dict[str, LinkList], robots.links_tables),
    "rules": lambda text: rules.rules_table((a_rule(text),)),
    "held records": of(list[Held], plane.held_table),
    "place": lambda text: plane.place_table(filled(Record, text), filled(RecordPlace, text), text),
    "stop": of(StopAnswer, lambda answer: Stopped(unknown=("[/red]",), answer=answer).text()),
}


def printed(value: Any) -> str:
    """Return what the console prints, without line breaks and blanks."""
    before = console.out.width
    console.out.width = 100_000
    try:
        with console.out.capture() as capture:
            console.out.print(value)
    finally:
        console.out.width = before
    return "".join(capture.get().split())


@pytest.mark.parametrize("name", SHOWN)
def test_brackets_are_printed_as_they_are(name: str) -> None:
    """No table is broken by them, and none loses any of it."""
    assert "".join(CRASHES.split())[:30] in printed(SHOWN[name](CRASHES))


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.text("[]/\\:@=ab red", max_size=20) | st.text(max_size=20))
def test_no_text_breaks_a_table(text: str) -> None:
    """Whatever brackets, marks and letters it is made of."""
    for show in SHOWN.values():
        printed(show(text))


class Steered:
    """A fleet whose audit, stops and questions hold the text."""

    async def __aenter__(self) -> "Steered":
        return self

    async def __aexit__(self, *_: object) -> None:
        """Nothing is open."""

    async def acts(self, limit: int) -> Any:
        """Return one order, and a gateway that does not tell."""
        del limit
        return (filled(Act, CRASHES),), {CRASHES: RefusedError(CRASHES, remedy=CRASHES)}

    async def standing(self) -> Any:
        """Return one of each."""
        return types.SimpleNamespace(active=(filled(SoftStop, CRASHES),), leases=(filled(Lease, CRASHES),))

    async def enquiries(self) -> Any:
        """Return one, and a gateway that does not tell."""
        return types.SimpleNamespace(enquiries=(filled(Enquiry, CRASHES),), unreachable=(CRASHES,))

    async def stop(self, robots: Any, *, why: str) -> Any:
        """Refuse it."""
        raise RefusedError(f"{robots} {why} {CRASHES}", remedy=CRASHES)


@pytest.mark.parametrize(
    ("words", "code"), [(["audit"], 0), (["stops"], 0), (["questions"], 0), (["stop", "--why", CRASHES], 4)]
)
def test_commands_print_it_as_it_is(
    words: list[str], code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Orders, stops, questions and errors, too."""

    def steered(_: object) -> Steered:
        return Steered()

    monkeypatch.setattr(common, "FleetClient", steered)
    with pytest.raises(SystemExit) as ended:
        cli.main([*words, "--connect", "tcp/127.0.0.1:1"])
    said = capsys.readouterr()
    assert ended.value.code == code
    assert "".join(CRASHES.split()) in "".join((said.out + said.err).split())


def test_control_characters_of_a_text_reach_no_terminal() -> None:
    """Escape sequences, bells and direction overrides in an instruction are shown as such; styles still work."""
    stream = StringIO()
    shown = SafeConsole(file=stream, force_terminal=True, color_system="standard", width=120, legacy_windows=False)
    shown.print(Text("go \x1b[2J\x07\x9b31m\u202eback", style="red"), markup=False)
    text = stream.getvalue()
    assert text.startswith("\x1b[31m")
    assert "\x1b[2J" not in text
    assert not set("\x07\x9b\u202e") & set(text)
    assert "go \ufffd[2J\ufffd31m\ufffdback" in text
