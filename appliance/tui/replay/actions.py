"""What can be done with a recorded log."""

from appliance.tui.action import Action, Parameter

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
