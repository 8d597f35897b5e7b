"""What an operator can do about a failure that came without a remedy of its own, by its code. Pure.

Failures come from handlers (people's code), from robots, from other gateways and from the appliance's own errors. Where
the code that failed knew a remedy it is kept. Where it did not, the coordinator adds the one of the code here, so that
no task ends as failed without a next step.
"""

from msgspec.structs import replace

from appliance.model import Failure

_AGAIN = "`swiftbot task retry {task}` tries it again"
_LOG = "the last lines of its run and the gateway's log say more (`swiftbot task watch {task}`)"
_SKILL = f"correct the skill's handler: {_LOG}"
_ROBOT = f"check the robot (`swiftbot robots`), then {_AGAIN}"
_FLEET = f"check that all gateways run (`swiftbot fleet`), then {_AGAIN}"

BY_CODE: dict[str, str] = {
    # Of the error tree (`appliance.errors`).
    "internal": f"this is a fault of the gateway: {_LOG}; {_AGAIN}",
    "config": "correct the key that the message names; `swiftbot doctor` checks the configuration",
    "payload": "correct what the message names, then submit it again",
    "prerequisite": "`swiftbot doctor` says what the machine lacks",
    "unreachable": _FLEET,
    "deadline": f"give it more time (`timeout_s` of the skill, `--deadline` of the task), then {_AGAIN}",
    "conflict": _AGAIN,
    "superseded": _AGAIN,
    "stale": _AGAIN,
    "withdrawn": _AGAIN,
    "not-found": "check the name; `swiftbot fleet` and `swiftbot robots` list what there is",
    "refused": f"remove the reason that the message gives, then {_AGAIN}",
    "unapproved": "`swiftbot task retry {task}` asks for approval again (`swiftbot task approve {task}`)",
    "plan": "rephrase the instruction, or correct the plan, and submit it again",
    "pool": f"check the containers (`swiftbot pool`, `swiftbot doctor`), then {_AGAIN}",
    "robot": _ROBOT,
    "contract": "`swiftbot robots check NAME` says what the robot's program does not keep to",
    "precondition": "add the step that is missing, such as the way there, and submit it again",
    "taken": f"wait until its pilot gives the robot back, then {_AGAIN}",
    "record": "check that the disk has room; `swiftbot doctor` says more",
    "cancelled": _AGAIN,
    # Of runs.
    "skill": _SKILL,
    "crashed": _SKILL,
    "hung": f"raise timeout_s in its skill.toml, or find out what its handler waits for: {_LOG}",
    "memory": "raise memory_mb in its skill.toml",
    "preload": "correct the skill's `preload`: the gateway's log says what could not be loaded",
    "disk": "make room on the disk of the volumes, or have the skill write less",
    "stopped": f"its container was ended: {_AGAIN}",
    "orphaned": f"its gateway lost it: {_AGAIN}",
    "stuck": f"raise silent_s in its skill.toml, or find out what its handler waits for: {_LOG}",
    "straggling": _LOG,
    "busy": f"wait until the robot is free, then {_AGAIN}",
}
"""A remedy for each code that the appliance itself uses; `{task}` becomes the task's id."""
OTHER = f"{_LOG}; {_AGAIN}"
"""For a code that a handler or a robot made up."""


def remedied(failure: Failure, task: str) -> Failure:
    """Return a failure with a remedy: its own, or the one of its code."""
    if failure.remedy.strip():
        return failure
    return replace(failure, remedy=BY_CODE.get(failure.code, OTHER).replace("{task}", task))
