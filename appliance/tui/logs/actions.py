"""What can be done on the screen of the log."""

from appliance.tui.action import Action, Parameter

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
