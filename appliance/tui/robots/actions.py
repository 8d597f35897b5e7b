"""What can be done with robots: taking one over, answering what it asks, stopping them and letting them go."""

from appliance.client import FleetClient
from appliance.errors import RefusedError
from appliance.model.steering import MAX_WHY
from appliance.stopping import unknown_text
from appliance.tui.action import WHY, Action, Given, Parameter
from appliance.tui.safe import safe


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
