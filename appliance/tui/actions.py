"""The registry of all actions of the terminal UI: it feeds keys, footer, help, `:` line and command palette."""

from appliance.tui import orders
from appliance.tui.action import WHY, Action, Parameter
from appliance.tui.logs.actions import LOGS
from appliance.tui.replay.actions import REPLAY
from appliance.tui.robots.actions import ROBOTS
from appliance.tui.tasks.actions import TASKS

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
        do=orders.acts,
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
        do=orders.drain,
    ),
    Action(
        name="undrain",
        title="Undrain",
        help="Have a gateway take runs again",
        keys=("u",),
        screens=("fleet", "gateway"),
        takes=(_GATEWAY, WHY),
        writes=True,
        do=orders.undrain,
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
        do=orders.swap,
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
        do=orders.warm,
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
        do=orders.evict,
    ),
    Action(
        name="release",
        title="Release",
        help="Start containers of an image again that is in quarantine",
        keys=("r",),
        screens=("pool",),
        takes=(_IMAGE, _ANY_GATEWAY, WHY),
        writes=True,
        do=orders.release,
        footer=False,
    ),
    Action(
        name="fetch",
        title="Fetch",
        help="Have a gateway bring an image to itself, by its full reference",
        takes=(Parameter(kind="text", name="reference"), _GATEWAY, WHY),
        writes=True,
        do=orders.fetch,
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
