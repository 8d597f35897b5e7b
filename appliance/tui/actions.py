"""The registry of all actions of the terminal UI: it feeds keys, footer, help, `:` line and command palette.

An action has a name, keys and help. It either calls something of the UI itself (`call`) or asks something of the fleet
(`do`): a coroutine that takes the arguments as typed, ends in a sentence and raises `SwiftbotError` with a remedy, like
the command line, whose client it uses. What an action `takes` comes from what is selected on the screen, or is written
on the `:` line. Key bindings are made from the registry and from a person's own settings.
"""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace

from msgspec import Struct
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from textual.binding import Binding
from textual.widgets import Input

from appliance.client import FleetClient, cancel_outcome, unknown_text
from appliance.errors import ConfigError, PayloadError, RefusedError
from appliance.model import TaskRecord, TaskState
from appliance.model.steering import MAX_WHY
from appliance.pool.api import Evicted, WarmAsk
from appliance.reasons import why_text
from appliance.tasks.api import MigrateAsk
from appliance.tui.formatting import counted, time_of_day
from appliance.tui.safe import safe

Given = Mapping[str, str]
Do = Callable[[FleetClient, Given, str], Awaitable[RenderableType | TaskRecord]]
"""Asks it of the fleet with the arguments given, in the name of an operator; returns what came of it: a sentence, the
task as it is now or, for a `long` one, something to be read."""


class Parameter(Struct, frozen=True, kw_only=True):
    """An argument of an action."""

    kind: str
    """What it is: gateway, robot, task, subtask (`task/subtask`), container, image, theme, number, text, file."""
    name: str
    optional: bool = False
    chosen: bool = False
    """Whether an optional one is taken from the selection as well."""
    absent: str = ""
    """What a confirmation calls it when it is not given."""
    rest: bool = False
    """Whether it is all that follows on the line."""

    @property
    def usage(self) -> str:
        """As help writes it."""
        word = f"{self.name.upper()}…" if self.rest else self.name.upper()
        return f"[{word}]" if self.optional else word


WHY = Parameter(kind="text", name="why", optional=True, rest=True)
"""Why an order is given, for the audit and for those who wonder."""


class Action(Struct, frozen=True, kw_only=True):
    """Something a person can do."""

    name: str
    """The command's word after the colon, and what a person's settings call it."""
    title: str
    """What the footer says."""
    help: str
    keys: tuple[str, ...] = ()
    """In Textual's names."""
    screens: tuple[str, ...] = ()
    """Where its keys work; empty: everywhere."""
    takes: tuple[Parameter, ...] = ()
    aliases: tuple[str, ...] = ()
    writes: bool = False
    """Whether it changes anything in the fleet: not while the UI is read-only."""
    always: bool = False
    """Whether it works read-only all the same, and in dialogs and input fields: a stop must always work."""
    dangerous: bool = False
    """Whether it asks first, with `confirm`."""
    confirm: str = ""
    """What will happen, in plain words; `{…}` are its arguments."""
    sees_stops: bool = False
    """Whether its argument `stops` is the ids of the soft stops in force, with `/` between, as it was begun."""
    call: str = ""
    """Textual's action of the application; with `{…}` for arguments."""
    do: Do | None = None
    long: bool = False
    """Whether what comes of it is a text to be read at leisure, instead of a sentence."""
    footer: bool = True

    @property
    def usage(self) -> str:
        """The command line's form of it."""
        return " ".join([f":{self.name}", *(each.usage for each in self.takes)])

    @property
    def shown(self) -> str:
        """Its keys as people write them."""
        return " ".join(key_name(key) for key in self.keys)

    def sentence(self, given: Given) -> str:
        """Return what a confirmation says."""
        absent = {each.name: each.absent or f"any {each.name}" for each in self.takes}
        why = f" Why: {given['why']}" if given.get("why") else ""
        return f"{self.confirm.format_map(absent | dict(given))}{why}"

    def here(self, scope: str) -> bool:
        """Whether its keys work on a screen."""
        return not self.screens or scope in self.screens


_NAMES = {
    "question_mark": "?",
    "slash": "/",
    "colon": ":",
    "escape": "Esc",
    "tab": "Tab",
    "shift+tab": "⇧Tab",
    "enter": "Enter",
    "exclamation_mark": "!",
    "space": "Space",
    "delete": "Del",
    "left_square_bracket": "[",
    "right_square_bracket": "]",
    "plus": "+",
    "minus": "-",
    "equals_sign": "=",
    "left": "←",
    "right": "→",
}


def key_name(key: str) -> str:
    """Return a key as people write it."""
    if key in _NAMES:
        return _NAMES[key]
    if key.startswith("ctrl+"):
        return f"^{key.removeprefix('ctrl+')}"
    if len(key) > 1 and key[0] == "f" and key[1:].isdecimal():
        return key.upper()
    return key


WARM_WAIT_S = 30.0
MOST_WARM = 100


def number(given: Given, name: str, default: int, *, least: int, most: int) -> int:
    """Return a whole number that was given; PayloadError when it is none or out of range."""
    text = given.get(name, "")
    if not text:
        return default
    if not text.isdecimal() or not least <= int(text[:9]) <= most:
        raise PayloadError(f"{name} {text[:20]!r}", remedy=f"give a whole number from {least} to {most}")
    return int(text)


def _why(given: Given) -> str:
    return given.get("why", "")


# --- the audit ----------------------------------------------------------------------------------------------


async def acts(fleet: FleetClient, given: Given, _by: str) -> RenderableType:
    """Tell what operators ordered lately, and what came of it."""
    found, silent = await fleet.acts(number(given, "count", 50, least=1, most=500))
    table = Table(box=None, pad_edge=False)
    for title in ("at", "who", "what", "of", "outcome", "why"):
        table.add_column(title, overflow="fold")
    for each in found:
        outcome = each.outcome if not each.problem else f"{each.outcome}: {each.problem}"
        cells = (each.by, each.verb, each.target, outcome, each.why)
        table.add_row(time_of_day(each.at_ns), *(Text(safe(cell, 200)) for cell in cells))
    lines = [Text(f"{safe(name, 63)} did not tell: {safe(error.message)}", "yellow") for name, error in silent.items()]
    return Group(table if found else Text("no orders yet", "dim"), *lines)


# --- gateways ------------------------------------------------------------------------------------------------


async def drain(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have a gateway give its runs away and take no more."""
    state = await fleet.drain(given["gateway"], 0.0, why=_why(given))
    return f"{state.gateway} drains: {counted(len(state.left), 'run')} left"


async def undrain(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have a gateway take runs again."""
    state = await fleet.undrain(given["gateway"], why=_why(given))
    return f"{state.gateway} takes runs again"


async def swap(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have a gateway plan with another local model."""
    swapped = await fleet.swap_model(given["gateway"], given["folder"], why=_why(given))
    return f"{given['gateway']} plans with {swapped.after} instead of {swapped.before}"


# --- pools ---------------------------------------------------------------------------------------------------


async def warm(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have containers of an image ready."""
    count = number(given, "count", 1, least=1, most=MOST_WARM)
    name = given.get("gateway") or await fleet.gateway()
    ask = WarmAsk(image=given["image"], count=count, wait_s=WARM_WAIT_S, why=_why(given))
    found = await fleet.pool_warm(name, ask)
    problem = f"; {found.problem}" if found.problem else ""
    return f"{name}: {found.ready} of {found.image} ready, {found.starting} starting{problem}"


async def evict(fleet: FleetClient, given: Given, _by: str) -> str:
    """Give up a container, or all idle ones of an image."""
    answers = await fleet.pool_evict(given["container"], given.get("gateway", ""), why=_why(given))
    return "; ".join(_evicted(name, answers[name]) for name in sorted(answers))


def _evicted(gateway: str, answer: Evicted) -> str:
    kept = "".join(f", kept {name}: {why}" for name, why in sorted(answer.kept.items()))
    note = f" ({answer.note})" if answer.note else ""
    return f"{gateway}: {len(answer.containers)} given up{kept}{note}"


async def release(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have an image started again that is in quarantine."""
    found = await fleet.pool_release(given["image"], given.get("gateway", ""), why=_why(given))
    return "; ".join(f"{each}: started again, it was left alone: {found[each].reason}" for each in sorted(found))


async def fetch(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have a gateway bring an image to itself."""
    brought = await fleet.image_fetch(given["gateway"], given["reference"], why=_why(given))
    whence = f" from {brought.gateway}" if brought.gateway else ": it was there already"
    return f"{brought.what} is on {given['gateway']}{whence}"


def split_subtask(text: str) -> tuple[str, str]:
    """Return task and subtask of `t-1/s2`.

    Raises:
        PayloadError: it is not written so.
    """
    task, _, subtask = text.partition("/")
    if not task or not subtask:
        raise PayloadError(f"{text[:60]!r} is no subtask", remedy="write task/subtask, such as t-1/s2")
    return task, subtask


async def cancel(fleet: FleetClient, given: Given, _by: str) -> TaskRecord | str:
    """Stop a task."""
    record = await fleet.cancel(given["task"], why=given.get("why", ""))
    # The record is shown in its row at once; what is none of its own doing is said in words.
    return record if record.state in (TaskState.CANCELLING, TaskState.CANCELLED) else cancel_outcome(record)


async def why(fleet: FleetClient, given: Given, _by: str) -> RenderableType:
    """Tell why a task or subtask waits, or was served where it was."""
    task, _, subtask = given["task"].partition("/")
    return why_text(await fleet.why(task, subtask))


async def migrate(fleet: FleetClient, given: Given, _by: str) -> str:
    """Move a subtask's run to another gateway."""
    task, subtask = split_subtask(given["subtask"])
    ask = MigrateAsk(task=task, subtask=subtask, to=given.get("gateway", ""), why=given.get("why", ""))
    moved = await fleet.migrate(ask)
    if not moved.moved:
        return f"{moved.subtask} was not moved: {moved.why}"
    state = "started there" if moved.started else "not yet started there"
    return f"{moved.subtask} moved from {moved.source} to {moved.target}, {state} after {moved.took_ms:.0f} ms"


async def pause(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """Start no further subtask."""
    return await fleet.pause(given["task"], why=given.get("why", ""))


async def hold(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """The same, and end runs that go on from a checkpoint later."""
    return await fleet.pause(given["task"], hold=True, why=given.get("why", ""))


async def resume(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """Let it go on."""
    return await fleet.resume(given["task"], why=given.get("why", ""))


async def retry(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """Try again what failed."""
    return await fleet.retry(given["task"], why=given.get("why", ""))


async def retry_subtask(fleet: FleetClient, given: Given, _by: str) -> TaskRecord:
    """Try one subtask again."""
    task, subtask = split_subtask(given["subtask"])
    return await fleet.retry(task, subtask, why=given.get("why", ""))


_TASK = Parameter(kind="task", name="task")
_SUBTASK = Parameter(kind="subtask", name="subtask")
_STEP = Parameter(kind="step", name="step")

TASKS: tuple[Action, ...] = (
    Action(
        name="cancel",
        title="Cancel",
        help="Cancel a task",
        keys=("c",),
        screens=("tasks", "task"),
        takes=(_TASK, WHY),
        writes=True,
        dangerous=True,
        confirm="Cancel task {task}? Its runs are ended where they are, and what has not begun never will.",
        do=cancel,
    ),
    Action(
        name="why",
        title="Why",
        help="Why a task or subtask waits, or ran where it did, with all that was weighed",
        keys=("y",),
        screens=("tasks", "task", "pool"),
        takes=(_TASK,),
        do=why,
        long=True,
    ),
    Action(
        name="migrate",
        title="Move",
        help="Move a running subtask to another gateway, with its checkpoint",
        keys=("m",),
        screens=("tasks", "task"),
        takes=(_SUBTASK, Parameter(kind="gateway", name="gateway", optional=True), WHY),
        writes=True,
        do=migrate,
    ),
    Action(
        name="review",
        title="Review",
        help="Look at a plan that waits: approve, edit or reject it",
        keys=("a",),
        screens=("tasks", "task"),
        takes=(_TASK,),
        call="review",
    ),
    Action(
        name="pause",
        title="Pause",
        help="Start no further subtask of a task; what runs goes on",
        keys=("p",),
        screens=("tasks", "task"),
        takes=(_TASK, WHY),
        writes=True,
        do=pause,
    ),
    Action(
        name="hold",
        title="Hold",
        help="Pause a task and end runs that can go on from a checkpoint later",
        screens=("tasks", "task"),
        takes=(_TASK, WHY),
        writes=True,
        dangerous=True,
        confirm="Hold task {task}? Nothing more of it is started, and runs that keep checkpoints are ended.",
        do=hold,
        footer=False,
    ),
    Action(
        name="resume",
        title="Resume",
        help="Let a paused task go on",
        keys=("r",),
        screens=("tasks", "task"),
        takes=(_TASK, WHY),
        writes=True,
        dangerous=True,
        confirm="Resume task {task}? What waits in it is started, and its robots may move.",
        do=resume,
    ),
    Action(
        name="retry",
        title="Retry",
        help="Try again what failed or was cancelled in a task; what succeeded is kept",
        keys=("t",),
        screens=("tasks", "task"),
        takes=(_TASK, WHY),
        writes=True,
        dangerous=True,
        confirm="Try task {task} again? What failed or was cancelled runs once more; what succeeded is kept.",
        do=retry,
    ),
    Action(
        name="retry-subtask",
        title="Retry one",
        help="Try one subtask again",
        screens=("task",),
        takes=(_SUBTASK, WHY),
        writes=True,
        dangerous=True,
        confirm="Try {subtask} again? It runs once more.",
        do=retry_subtask,
        footer=False,
    ),
    # --- a plan under review
    Action(
        name="approve",
        title="Approve",
        help="Let the plan run as it stands here",
        keys=("a",),
        screens=("review",),
        takes=(WHY,),
        writes=True,
        call="here approve",
    ),
    Action(
        name="reject",
        title="Reject",
        help="Turn the plan down",
        keys=("x",),
        screens=("review",),
        takes=(WHY,),
        writes=True,
        call="here reject",
    ),
    Action(
        name="edit-robot",
        title="Robot",
        help="Have another robot do the subtask",
        keys=("r",),
        screens=("review",),
        takes=(_STEP, Parameter(kind="robot", name="robot")),
        call="here edit_robot",
    ),
    Action(
        name="edit-params",
        title="Params",
        help="Change the parameters of the subtask",
        keys=("e",),
        screens=("review",),
        takes=(_STEP, Parameter(kind="text", name="parameters", optional=True, rest=True)),
        call="here edit_params",
    ),
    Action(
        name="edit-after",
        title="After",
        help="Change what the subtask comes after",
        keys=("o",),
        screens=("review",),
        takes=(_STEP, Parameter(kind="text", name="others", optional=True, rest=True)),
        call="here edit_after",
    ),
    Action(
        name="edit-out",
        title="Drop",
        help="Take the subtask out of the plan",
        keys=("d",),
        screens=("review",),
        takes=(_STEP,),
        call="here edit_out",
    ),
    Action(
        name="edit-up",
        title="Earlier",
        help="Have the subtask change places with the one before it",
        keys=("left_square_bracket",),
        screens=("review",),
        takes=(_STEP,),
        call="here edit_up",
        footer=False,
    ),
    Action(
        name="edit-down",
        title="Later",
        help="Have the subtask change places with the one after it",
        keys=("right_square_bracket",),
        screens=("review",),
        takes=(_STEP,),
        call="here edit_down",
        footer=False,
    ),
    Action(
        name="edit-undo",
        title="Undo",
        help="Go back one edit",
        keys=("u",),
        screens=("review",),
        call="here edit_undo",
    ),
    Action(
        name="edit-reload",
        title="Reload",
        help="Look at the plan that waits now, without the edits",
        screens=("review",),
        call="here edit_reload",
        footer=False,
    ),
)


async def answer(fleet: FleetClient, given: Given, _by: str) -> str:
    """Answer a question; the first answer counts."""
    enquiry = await fleet.answer(given["question"], given["answer"])
    return f"answered: {safe(enquiry.question, 120)} → {safe(enquiry.answer or '', 120)}"


async def stop(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have robots hold and do nothing until they are let go: all, or one.

    A first word that is no robot's name begins the reason, and all robots are stopped: a name that is written wrongly
    must not stop nobody.
    """
    robot, why = given.get("robot", ""), given.get("why", "")
    if robot and not fleet.knows_robot(robot):
        return await stop_these(fleet, (), f"{robot} {why}".strip())
    return await stop_these(fleet, (robot,) if robot else (), why)


async def stop_one(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have one robot hold."""
    return await stop_these(fleet, (given["robot"],), given.get("why", ""))


async def stop_in_words(fleet: FleetClient, given: Given, _by: str) -> str:
    """Stop the robots that an instruction names, or all; a name that no robot has stops none, and is reported first."""
    robots, unknown, roster = (tuple(filter(None, given[name].split("/"))) for name in ("robots", "unknown", "roster"))
    lost = [unknown_text(name, roster) for name in unknown]
    if lost and not robots:
        raise RefusedError("; ".join(lost), remedy="F8 or :stop stops all robots")
    return "; ".join([*lost, await stop_these(fleet, robots, given["why"][:MAX_WHY])])


async def stop_these(fleet: FleetClient, robots: tuple[str, ...], why: str) -> str:
    """Stop robots, or all when none is named; return who holds and who does not."""
    answer = await fleet.stop(robots, why=why)
    held = f"holding: {', '.join(answer.robots)}" if answer.robots else "no robot has confirmed yet"
    problems = "".join(f"; NOT {name}: {why}" for name, why in sorted(answer.problems.items()))
    silent = f"; not confirmed by {', '.join(answer.silent)}" if answer.silent else ""
    return f"soft stop of {', '.join(robots) or 'the fleet'}: {held}{problems}{silent}"


async def resume_robots(fleet: FleetClient, given: Given, _by: str) -> str:
    """Lift the soft stops that the operator has seen: of all robots, or one."""
    robots = (given["robot"],) if given.get("robot") else ()
    stops = [each for each in given.get("stops", "").split("/") if each]
    answer = await fleet.resume_robots(robots, stops=stops, why=given.get("why", ""))
    left = f"; soft stops still in force for others: {len(answer.stops)}" if answer.stops else ""
    return f"{robots[0] if robots else 'all robots'} may move again{left}"


_ROBOT = Parameter(kind="robot", name="robot")

ROBOTS: tuple[Action, ...] = (
    Action(
        name="takeover",
        title="Take over",
        help="Take a robot over and move it by hand while a key is held",
        keys=("o",),
        screens=("robots", "robot"),
        takes=(_ROBOT, WHY),
        writes=True,
        call="takeover",
    ),
    Action(
        name="give-back",
        title="Give back",
        help="Give the robot back and leave",
        keys=("g",),
        screens=("takeover",),
        call="here give_back",
    ),
    Action(
        name="answer",
        title="Answer",
        help="Answer what a robot or skill asks; the first answer counts",
        keys=("A",),
        screens=("robots", "robot"),
        takes=(
            Parameter(kind="enquiry", name="question"),
            Parameter(kind="text", name="answer", rest=True),
        ),
        writes=True,
        do=answer,
    ),
    Action(
        name="stop",
        title="STOP all",
        help="Soft stop: all robots hold and do nothing until they are let go; no emergency stop. `:stop ROBOT`: one",
        keys=("f8",),
        takes=(Parameter(kind="robot", name="robot", optional=True), WHY),
        writes=True,
        always=True,
        do=stop,
    ),
    Action(
        name="stop-robot",
        title="Stop",
        help="Soft stop of one robot",
        keys=("x",),
        screens=("robots", "robot"),
        takes=(_ROBOT, WHY),
        writes=True,
        always=True,
        do=stop_one,
    ),
    Action(
        name="resume-robots",
        title="Let go",
        help="Lift the soft stop of a robot, or of all",
        keys=("z",),
        screens=("robots", "robot"),
        takes=(Parameter(kind="robot", name="robot", optional=True, chosen=True, absent="all robots"), WHY),
        writes=True,
        dangerous=True,
        confirm="Lift the soft stop of {robot}? It may move at once, as its task goes on. Is the way clear?",
        sees_stops=True,
        do=resume_robots,
    ),
    Action(
        name="resume-all",
        title="Let all go",
        help="Lift the soft stops of all robots, wherever the cursor is",
        keys=("Z",),
        screens=("robots", "robot"),
        takes=(WHY,),
        writes=True,
        dangerous=True,
        confirm="Lift the soft stops of all robots? They may move at once, as their tasks go on. Is the way clear?",
        sees_stops=True,
        do=resume_robots,
    ),
)

STOP_IN_WORDS = Action(
    name="stop",
    title="STOP",
    help="Soft stop of the robots that an instruction says to stop",
    writes=True,
    always=True,
    do=stop_in_words,
)
"""What becomes of an instruction that is a stop; it is no command of its own."""


LOGS: tuple[Action, ...] = (
    Action(
        name="follow",
        title="Follow",
        help="Stay at the newest line, or where it is",
        keys=("f",),
        screens=("log",),
        call="here follow",
    ),
    Action(
        name="listen",
        title="Keys",
        help="Show what is put on keys, such as `robot/rover_1/**`; without an expression the log again",
        screens=("log",),
        takes=(Parameter(kind="text", name="keys", optional=True),),
        call="here listen",
        footer=False,
    ),
    Action(
        name="keys",
        title="Keys",
        help="Write the keys that are to be shown",
        keys=("e",),
        screens=("log",),
        call="here write_keys",
    ),
    Action(
        name="wipe",
        title="Wipe",
        help="Forget the lines that are shown",
        keys=("x",),
        screens=("log",),
        call="here wipe",
    ),
)


REPLAY: tuple[Action, ...] = (
    Action(
        name="open",
        title="Open",
        help="Show a recorded log on all screens",
        takes=(Parameter(kind="file", name="file"),),
        call="open",
        footer=False,
    ),
    Action(
        name="live", title="Live", help="Leave the recorded log: show the fleet again", keys=("L",),
        screens=("replay",), call="live",
    ),
    Action(name="play", title="Play", help="Play or pause", keys=("space",), screens=("replay",), call="here play"),
    Action(
        name="behind", title="−10 s", help="Go ten seconds back", keys=("left",), screens=("replay",),
        call="here behind",
    ),
    Action(
        name="ahead", title="+10 s", help="Go ten seconds on", keys=("right",), screens=("replay",),
        call="here ahead",
    ),
    Action(
        name="slower", title="Slower", help="Play slower", keys=("minus",), screens=("replay",), call="here slower",
    ),
    Action(
        name="faster", title="Faster", help="Play faster", keys=("plus", "equals_sign"), screens=("replay",),
        call="here faster",
    ),
    Action(
        name="seek",
        title="Seek",
        help="Go to a moment: 90, 1:30, 50%, +10, -10",
        keys=("g",),
        screens=("replay",),
        takes=(Parameter(kind="text", name="time"),),
        call="here seek",
    ),
    Action(
        name="rate",
        title="Rate",
        help="Play so many log seconds a second",
        screens=("replay",),
        takes=(Parameter(kind="number", name="rate"),),
        call="here rate",
        footer=False,
    ),
)  # fmt: skip


_GATEWAY = Parameter(kind="gateway", name="gateway")
_ANY_GATEWAY = Parameter(kind="gateway", name="gateway", optional=True)
_IMAGE = Parameter(kind="image", name="image")

SCREENS: dict[str, tuple[str, str]] = {
    "fleet": ("Fleet", "Gateways: load, memory, pool, tasks, links; Enter shows one whole"),
    "tasks": ("Tasks", "Tasks; Enter opens one with the graph of its plan"),
    "robots": ("Robots", "Robots: mode, battery, position, mission; a map; Enter shows one whole"),
    "pool": ("Pool", "Containers by image, and why they were started and given up"),
    "llm": ("LLM", "Planning by language models: tiers, queue, speed, confidence"),
    "learning": ("Learning", "Rounds of federated learning"),
    "log": ("Log", "Notices, runs and log lines as they come, or any keys"),
    "replay": ("Replay", "A recorded log on all screens: play, pause, seek, rate"),
}
"""Screens in the order of their number keys: title and what they show."""


def _screens() -> tuple[Action, ...]:
    return tuple(
        Action(name=name, title=title, help=shows, keys=(str(number),), call=f"screen {name}", footer=False)
        for number, (name, (title, shows)) in enumerate(SCREENS.items(), start=1)
    )


ACTIONS: tuple[Action, ...] = (
    *_screens(),
    # --- tasks
    Action(
        name="submit",
        title="Submit",
        help="Plan an instruction, look at the plan, run it",
        keys=("s",),
        takes=(Parameter(kind="text", name="instruction", optional=True, rest=True),),
        writes=True,
        call="submit",
    ),
    *TASKS,
    *ROBOTS,
    *LOGS,
    *REPLAY,
    Action(
        name="acts",
        title="Audit",
        help="What operators ordered lately, and what came of it",
        takes=(Parameter(kind="number", name="count", optional=True),),
        do=acts,
        long=True,
        footer=False,
    ),
    # --- gateways
    Action(
        name="drain",
        title="Drain",
        help="Have a gateway give its runs away and take no more",
        keys=("d",),
        screens=("fleet", "gateway"),
        takes=(_GATEWAY, WHY),
        writes=True,
        dangerous=True,
        confirm="Drain {gateway}? Its runs are moved to other gateways, and it takes none until it is undrained.",
        do=drain,
    ),
    Action(
        name="undrain",
        title="Undrain",
        help="Have a gateway take runs again",
        keys=("u",),
        screens=("fleet", "gateway"),
        takes=(_GATEWAY, WHY),
        writes=True,
        do=undrain,
    ),
    Action(
        name="swap-model",
        title="Swap model",
        help="Have a gateway plan with another local model, which is tested before it takes over",
        keys=("m",),
        screens=("llm",),
        takes=(_GATEWAY, Parameter(kind="text", name="folder"), WHY),
        writes=True,
        dangerous=True,
        confirm="Have {gateway} plan with the model in {folder} from now on, until it is restarted?",
        do=swap,
    ),
    # --- pools
    Action(
        name="warm",
        title="Warm",
        help="Have containers of an image ready for ten minutes",
        keys=("w",),
        screens=("pool",),
        takes=(_IMAGE, Parameter(kind="number", name="count", optional=True), _ANY_GATEWAY, WHY),
        writes=True,
        do=warm,
    ),
    Action(
        name="evict",
        title="Evict",
        help="Give up an idle container, or all idle ones of an image",
        keys=("e",),
        screens=("pool",),
        takes=(Parameter(kind="container", name="container"), _ANY_GATEWAY, WHY),
        writes=True,
        dangerous=True,
        confirm="Give up {container}? The next run that needs such a container may have to wait for a cold start.",
        do=evict,
    ),
    Action(
        name="release",
        title="Release",
        help="Start containers of an image again that is in quarantine",
        keys=("r",),
        screens=("pool",),
        takes=(_IMAGE, _ANY_GATEWAY, WHY),
        writes=True,
        do=release,
        footer=False,
    ),
    Action(
        name="fetch",
        title="Fetch",
        help="Have a gateway bring an image to itself, by its full reference",
        takes=(Parameter(kind="text", name="reference"), _GATEWAY, WHY),
        writes=True,
        do=fetch,
        footer=False,
    ),
    # --- the UI itself
    Action(name="filter", title="Filter", help="Show rows that match an expression; !… all others", keys=("slash",),
           call="prompt /"),
    Action(name="command", title="Command", help="Write a command; Tab completes, ↑ brings back earlier ones",
           keys=("colon",), call="prompt :"),
    Action(name="back", title="Back", help="Leave what was opened; else show all rows again", keys=("escape",),
           call="back", footer=False),
    Action(name="next", title="Next part", help="Go to the next table or text", keys=("tab",), call="next_part",
           footer=False),
    Action(name="previous", title="Part before", help="Go to the table or text before", keys=("shift+tab",),
           call="previous_part", footer=False),
    Action(name="copy", title="Copy", help="Copy what is marked with the mouse; else say how to leave",
           keys=("ctrl+c",), call="copy", footer=False),
    Action(name="write", title="Unlock", help="Allow what changes the fleet", keys=("W",), call="unlock",
           footer=False),
    Action(name="read", title="Lock", help="Read only: allow nothing that changes the fleet", keys=("R",),
           call="lock", footer=False),
    Action(name="theme", title="Theme", help="Change the colours", keys=("T",),
           takes=(Parameter(kind="theme", name="theme", optional=True),), call="theme", footer=False),
    Action(name="picture", title="Picture", help="Write the screen as it is into an SVG file",
           takes=(Parameter(kind="file", name="file"),), call="picture", footer=False),
    Action(name="palette", title="Palette", help="All of these by name", keys=("ctrl+p",), call="command_palette",
           footer=False),
    Action(name="help", title="Help", help="Keys, commands and signs", keys=("question_mark",), call="help"),
    Action(name="quit", title="Quit", help="Leave; the fleet goes on", keys=("q", "ctrl+q"), call="quit",
           aliases=("q",)),
)  # fmt: skip
BY_NAME: dict[str, Action] = {action.name: action for action in ACTIONS}


def of(scope: str) -> tuple[Action, ...]:
    """Return the actions whose keys work on one screen and not everywhere."""
    return tuple(action for action in ACTIONS if scope in action.screens)


def everywhere() -> tuple[Action, ...]:
    """Return the actions whose keys work on every screen."""
    return tuple(action for action in ACTIONS if not action.screens)


PROMPTS = ("command", "filter")
"""Actions that open a line to be written; not while something is written (`app.check_action`)."""


def bindings(scope: str = "") -> list[Binding]:
    """Return the bindings of one screen, or of all of them when none is named."""
    found = of(scope) if scope else everywhere()
    return [
        Binding(
            ",".join(action.keys),
            f"app.act('{action.name}')",
            action.title,
            show=False,  # the frame has a footer of its own
            id=action.name,
            # A stop must be reached from dialogs and input fields as well; letters are for writing there.
            # The prompt is opened before the next key is given to anybody: what is typed ahead belongs into it.
            priority=action.name in PROMPTS or (action.always and all(len(key) > 1 for key in action.keys)),
        )
        for action in found
        if action.keys
    ]


DIALOG_KEYS: Mapping[str, str] = {"edit-first": "f2,ctrl+r"}
"""Keys of dialogs that are no actions of the registry, by the name under which they can be changed."""


def line_bindings() -> list[Binding]:
    """Return the editing keys of a line that is written, each with a name such as `line-delete-left-word`.

    They are Textual's own; the name is that of what they do there.
    """
    return [replace(each, id=_line_name(each)) for each in Input.BINDINGS if isinstance(each, Binding)]


def _line_name(binding: Binding) -> str:
    return "line-" + binding.action.replace("(True)", "-select").replace("_", "-")


def names() -> dict[str, tuple[str, ...]]:
    """Return all that can be given other keys: actions, keys of dialogs, editing keys; with their usual keys."""
    found = {action.name: action.keys for action in ACTIONS}
    found |= {name: tuple(keys.split(",")) for name, keys in DIALOG_KEYS.items()}
    for each in line_bindings():
        found[str(each.id)] = (*found.get(str(each.id), ()), *each.key.split(","))
    return found


def keymap(own: Mapping[str, str]) -> dict[str, str]:
    """Return Textual's keymap for a person's own keys by action.

    Raises:
        ConfigError: no such action, no key, or two actions of one screen share a key.
    """
    for name, keys in own.items():
        if name not in names():
            raise ConfigError(f"tui.keys: there is no action {name!r}", remedy="`?` and docs/tui.md list them")
        if not all(part.strip() for part in keys.split(",")):
            raise ConfigError(f"tui.keys.{name}: {keys!r} names no key", remedy='write keys such as "ctrl+x,f9"')
    taken: dict[tuple[str, str], str] = {}
    for action in ACTIONS:
        for key in keys_of(action, own):
            for scope in action.screens or ("",):
                other = taken.setdefault((scope, key), action.name)
                if other != action.name:
                    raise ConfigError(f"tui.keys: {key} is both {other} and {action.name}", remedy="change one of them")
    lines: dict[str, str] = {}
    for name, usual in names().items():
        if name.startswith("line-"):
            for key in _parts(own[name]) if name in own else usual:
                if (other := lines.setdefault(key, name)) != name:
                    raise ConfigError(f"tui.keys: {key} is both {other} and {name}", remedy="change one of them")
    return {name: ",".join(_parts(keys)) for name, keys in own.items()}


def keys_of(action: Action, own: Mapping[str, str]) -> tuple[str, ...]:
    """Return the keys of an action as a person has them."""
    if action.name in own:
        return _parts(own[action.name])
    return action.keys


def _parts(keys: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in keys.split(","))
