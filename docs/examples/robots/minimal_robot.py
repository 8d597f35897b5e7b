"""The least that a robot's own program does to be one of a fleet: docs/robot-contract.md, in Python and eclipse-zenoh.

    python minimal_robot.py FLEET NAME tcp/127.0.0.1:7447
    python minimal_robot.py FLEET NAME tls/GATEWAY:7447 robot-NAME.pem authority.crt    # docs/security.md

It drives in straight lines at 1 m/s and looks at nothing in its way; put your own base into `goto` and `hold`.
"""

import json
import math
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import zenoh

from appliance.robots.zenoh_client import ZenohTaskClient  # or a copy of that file

LONG_POLL_S = 9.0  # a question is held for at most 10 s
KEPT = 1000  # replies


class Failed(Exception):  # noqa: N818 - what a command came to
    """What a command is answered with when it is not done."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.failure = {"code": code, "message": message}


class Command:
    """A command that was taken up: under way until `reply` is there."""

    def __init__(self) -> None:
        self.reply: dict[str, Any] = {}
        self.ended, self.stop = threading.Event(), threading.Event()


class Robot:
    """One robot, and all that was asked of it."""

    def __init__(self, session: Any, fleet: str, name: str) -> None:
        self.name, self.x, self.y = name, 4.0, 4.0
        self.commands: OrderedDict[str, Command] = OrderedDict()  # by command id
        self.attempts: dict[tuple[str, str], int] = {}  # (task, subtask) -> the highest attempt that was seen
        self.lock = threading.Lock()
        self.verbs = {"goto": self.goto, "hold": self.hold}
        verbs = ("state", "stop", *self.verbs)
        # Raises where another robot has the name.
        self.registration = ZenohTaskClient(session, fleet=fleet, robot=name).register(uses=("base",), verbs=verbs)
        key = f"swiftbot/{fleet}/robot/{name}/command"
        # Each question in a thread of its own: `state` and `stop` are answered whatever is under way.
        take = lambda query: threading.Thread(target=self.answer, args=(query,), daemon=True).start()  # noqa: E731
        self.queryable = session.declare_queryable(key, take)

    def pose(self) -> dict[str, float]:
        """Return where it is, metres of the site."""
        return {"x": self.x, "y": self.y, "z": 0.0}

    def answer(self, query: Any) -> None:
        """Answer one query of the command key, whatever is in it."""
        try:
            command = json.loads(query.payload.to_bytes() if query.payload is not None else b"")
            id_, verb, args = command["id"], command["verb"], command.get("args", {})
            good = isinstance(id_, str) and id_ != "" and isinstance(verb, str) and isinstance(args, dict)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            good, command, id_, verb, args = False, {}, "", "", {}
        if not good:
            query.reply_err(json.dumps({"code": "payload", "message": "not a RobotCommand"}).encode())
            return
        try:
            reply = self.obey(command, id_, verb, args)
        except Failed as failed:
            reply = {"failure": failed.failure}
        if reply is None:  # asked again with the same id, by the contract
            query.reply_err(json.dumps({"code": "deadline", "message": f"{verb} is still under way"}).encode())
        else:
            query.reply(str(query.key_expr), json.dumps({"id": id_, **reply}).encode())

    def obey(self, command: dict[str, Any], id_: str, verb: str, args: dict[str, Any]) -> dict[str, Any] | None:
        """Return the reply, None while the command is under way."""
        if verb == "state":
            return {"result": {"pose": self.pose()}}
        if verb != "stop" and verb not in self.verbs:
            raise Failed("refused", f"{self.name} does not know {verb[:40]!r}, it can: {', '.join(self.verbs)}")
        with self.lock:
            of, attempt = (command.get("task", ""), command.get("subtask", "")), command.get("attempt", 0)
            if of[0] and attempt < self.attempts.get(of, 0):
                raise Failed("refused", f"attempt {attempt} has been overtaken by attempt {self.attempts[of]}")
            self.attempts[of] = attempt
            if verb == "stop":
                for key, each in self.commands.items():
                    if args.get("id") in (None, key):
                        each.stop.set()
                return {"result": {}}
            entry = self.commands.get(id_)
            if entry is None:
                if verb != "hold" and any(not each.ended.is_set() for each in self.commands.values()):
                    raise Failed("busy", f"{self.name} is busy")  # not kept: asked again it may be free
                for each in self.commands.values():
                    each.stop.set()  # hold ends what the base does
                entry = self.commands[id_] = Command()
                while len(self.commands) > KEPT:
                    self.commands.popitem(last=False)
                threading.Thread(target=self.run, args=(entry, self.verbs[verb], args), daemon=True).start()
        # A second question with this id joins the first, a later one gets the reply that is kept.
        return entry.reply if entry.ended.wait(LONG_POLL_S) else None

    def run(self, entry: Command, do: Callable[[Command, dict[str, Any]], Any], args: dict[str, Any]) -> None:
        """Carry a command out, and keep what came of it."""
        try:
            entry.reply = {"result": do(entry, args)}
        except Failed as failed:
            entry.reply = {"failure": failed.failure}
        except (TypeError, ValueError, KeyError, LookupError) as error:
            entry.reply = {"failure": {"code": "payload", "message": f"bad arguments: {error!r}"}}
        entry.ended.set()

    def goto(self, entry: Command, args: dict[str, Any]) -> dict[str, Any]:
        """Drive through the waypoints."""
        speed = min(1.0, float(args.get("speed_mps") or 1.0))
        for point in [(float(each["x"]), float(each["y"])) for each in args["waypoints"]]:
            while (left := math.dist((self.x, self.y), point)) > 0.01:
                if entry.stop.wait(0.05):
                    raise Failed("cancelled", "stopped on request")
                step = min(1.0, speed * 0.05 / left)
                self.x, self.y = self.x + (point[0] - self.x) * step, self.y + (point[1] - self.y) * step
        return {"pose": self.pose()}  # on arrival

    def hold(self, entry: Command, args: dict[str, Any]) -> dict[str, Any]:
        """Stay where it is."""
        seconds = args.get("duration_s") or 0.0
        if not isinstance(seconds, int | float):
            raise Failed("payload", "duration_s is no number")
        if entry.stop.wait(seconds):
            raise Failed("cancelled", "stopped on request")
        return {"pose": self.pose()}


def main() -> None:
    """Run until it is ended."""
    fleet, name, endpoint, *files = sys.argv[1:]
    config = zenoh.Config()
    settings: dict[str, Any] = {"mode": "client", "connect/endpoints": [endpoint]}
    if files:
        keys, authority = files
        tls = {
            "enable_mtls": True,
            "connect_private_key": keys,
            "connect_certificate": keys,
            "root_ca_certificate": authority,
        }
        settings |= {f"transport/link/tls/{key}": value for key, value in tls.items()}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        robot = Robot(session, fleet, name)
        while True:
            robot.registration.update(pose=robot.pose())
            time.sleep(0.2)


if __name__ == "__main__":
    main()
