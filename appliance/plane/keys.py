"""The key space: the one module that knows key names. `docs/keyspace.md` describes each of them.

Everything is under `swiftbot/{fleet}/`, so fleets on one network never meet. `{gateway}`, `{robot}`, `{task}`
are single chunks (`check_name`).
"""

import re

from appliance.errors import PayloadError

ROOT = "swiftbot"
_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]{0,62}")


def check_name(name: str, what: str) -> str:
    """Return `name` if it may be one chunk of a key; PayloadError otherwise."""
    if not _NAME.fullmatch(name):
        raise PayloadError(
            f"{what} {name[:80]!r} is not a valid name", remedy="use a-z, 0-9, '_', '.', '-'; at most 63"
        )
    return name


def run_of(key: str) -> tuple[str, str]:
    """Return task and subtask of a run event's key; empty where it is none."""
    parts = key.rsplit("/", 3)
    return (parts[1], parts[3]) if len(parts) == 4 and parts[2] == "run" else ("", "")


class Keys:
    """Key names of one fleet. Methods that take no name return the expression that matches all."""

    def __init__(self, fleet: str) -> None:
        self.fleet = check_name(fleet, "fleet")
        self.root = f"{ROOT}/{fleet}"

    def everything(self) -> str:
        """Every key of the fleet; the recorder subscribes to it."""
        return f"{self.root}/**"

    # gateways
    def alive(self, gateway: str = "*") -> str:
        """Liveliness token of a gateway."""
        return f"{self.root}/gw/{gateway}/alive"

    def alive_again(self, gateway: str = "*", number: str = "*") -> str:
        """A further token of a gateway that somebody does not see although they are linked."""
        return f"{self.root}/gw/{gateway}/alive/{number}"

    def status(self, gateway: str = "*") -> str:
        """Put: GatewayStatus."""
        return f"{self.root}/gw/{gateway}/status"

    def container(self, gateway: str = "*", container: str = "*") -> str:
        """Put: ContainerInfo; delete when it is gone."""
        return f"{self.root}/gw/{gateway}/pool/{container}"

    def rpc(self, gateway: str, verb: str = "*") -> str:
        """Queryable: a request to one gateway, answered with the verb's reply or ErrorReply."""
        return f"{self.root}/gw/{gateway}/rpc/{verb}"

    def backlog(self, session: str) -> str:
        """Queryable of each session that puts: what it has put lately (`plane.backlog`), for recorders."""
        return f"{self.root}/@backlog/{session}"

    def exchange(self, gateway: str = "*", verb: str = "*") -> str:
        """Put by the answering gateway: what was asked over RPC and answered (queries cannot be subscribed to)."""
        return f"{self.root}/gw/{gateway}/exchange/{verb}"

    def chunk(self, gateway: str, digest: str = "*", index: int | str = "*") -> str:
        """Queryable: a chunk of what a gateway has announced by that digest, raw bytes."""
        return f"{self.root}/gw/{gateway}/chunk/{digest}/{index}"

    def transfer(self, gateway: str = "*", transfer: str = "*") -> str:
        """Put by the gateway where it arrives: the progress of a transfer."""
        return f"{self.root}/gw/{gateway}/transfer/{transfer}"

    def log(self, gateway: str = "*") -> str:
        """Put: LogLine."""
        return f"{self.root}/gw/{gateway}/log"

    def migration(self, gateway: str = "*") -> str:
        """Put by a gateway that wants runs moved away: MigrationRequest."""
        return f"{self.root}/gw/{gateway}/migration"

    def decided(self, gateway: str = "*", what: str = "*") -> str:
        """Put: a decision with all that it rests on, so that a log can be checked: `placement`, `selection`, ..."""
        return f"{self.root}/gw/{gateway}/decided/{what}"

    # tasks
    def task(self, task: str = "*") -> str:
        """Put by the coordinator on every change: TaskRecord."""
        return f"{self.root}/task/{task}/record"

    def transition(self, task: str = "*") -> str:
        """Put by the coordinator: every input of the task's state machine, in order, for replay."""
        return f"{self.root}/task/{task}/transition"

    def run(self, task: str = "*", subtask: str = "*") -> str:
        """Put by the executing gateway: RunEvent."""
        return f"{self.root}/task/{task}/run/{subtask}"

    # robots
    def robot_alive(self, robot: str = "*") -> str:
        """Liveliness token of a robot that speaks Zenoh, or of the MAVLink gateway for one that does not."""
        return f"{self.root}/robot/{robot}/alive"

    def robot(self, robot: str = "*") -> str:
        """Put, a few times a second: RobotInfo."""
        return f"{self.root}/robot/{robot}/state"

    def command(self, robot: str) -> str:
        """Queryable: RobotCommand in, RobotReply out."""
        return f"{self.root}/robot/{robot}/command"

    def commanded(self, robot: str = "*") -> str:
        """Put by whoever answers commands: each RobotCommand as it is taken up."""
        return f"{self.root}/robot/{robot}/commanded"

    def camera(self, robot: str = "*") -> str:
        """Put: each picture taken, as foxglove.CompressedImage JSON."""
        return f"{self.root}/robot/{robot}/camera"

    def mavlink(self, robot: str = "*", direction: str = "*") -> str:
        """Put: each raw MAVLink frame; direction `rx` (from the vehicle) or `tx`."""
        return f"{self.root}/robot/{robot}/mavlink/{direction}"

    def links(self, gateway: str = "*") -> str:
        """Put every second by a gateway with MAVLink links: LinkList."""
        return f"{self.root}/gw/{gateway}/mavlink/links"

    def link_frames(self, gateway: str = "*", link: str = "*", direction: str = "*") -> str:
        """Put: each raw MAVLink frame of a link that is from or to no vehicle; direction `rx` (heard) or `tx`."""
        return f"{self.root}/gw/{gateway}/mavlink/{link}/{direction}"

    def intake(self, robot: str = "*") -> str:
        """Put by a robot: TaskRequest."""
        return f"{self.root}/robot/{robot}/task"

    # the simulated world, shared by the simulated robots of a site
    def world(self, thing: str = "*") -> str:
        """Put by a simulated robot: a thing that it picked up or put down (robots/sim/world.Thing)."""
        return f"{self.root}/world/{thing}"

    def world_of(self, robot: str = "*") -> str:
        """Queryable of a simulated robot: all things as it knows them, for those that come later."""
        return f"{self.root}/robot/{robot}/world"

    # people
    def notice(self, to: str = "*") -> str:
        """Put: Notice to a person."""
        return f"{self.root}/notice/{to}"

    # replays
    def clock(self) -> str:
        """Put by a replay: Clock, the time in the log that is being played."""
        return f"{self.root}/recorder/replay/clock"

    # operators
    def act(self, gateway: str = "*") -> str:
        """Put by the gateway that an operator's order was given to: Act, what came of it."""
        return f"{self.root}/operator/act/{gateway}"

    def soft_stop(self, act: str = "*") -> str:
        """Put by an operator's tool, and by the gateway that keeps it: SoftStop."""
        return f"{self.root}/operator/stop/{act}"

    def lifted(self, act: str = "*") -> str:
        """Put by the gateway that keeps it: Lifted, of soft stops."""
        return f"{self.root}/operator/resume/{act}"

    def lease(self, robot: str = "*") -> str:
        """Put when an operator takes a robot over, at each renewal and at the end: Lease."""
        return f"{self.root}/operator/lease/{robot}"

    def enquiry(self, enquiry: str = "*") -> str:
        """Put when a skill or robot asks people something, and when it is answered: Enquiry."""
        return f"{self.root}/operator/ask/{enquiry}"

    # recorders
    def recorder_status(self, recorder: str = "*") -> str:
        """Put every second: RecorderStatus."""
        return f"{self.root}/recorder/{recorder}/status"

    def recorder_trigger(self, recorder: str = "*") -> str:
        """Put: Trigger, something happened that is worth keeping. Recorder `every`: for all of them."""
        return f"{self.root}/recorder/{recorder}/trigger"

    def recorder_incident(self, recorder: str) -> str:
        """Only in logs, never put: Incident, what made the recorder keep what it has."""
        return f"{self.root}/recorder/{recorder}/incident"

    def recorder_view(self, recorder: str, robot: str, what: str) -> str:
        """Only in logs, never put: a robot's `pose`, `transform` or `location` in Foxglove's schemas."""
        return f"{self.root}/recorder/{recorder}/robot/{robot}/{what}"

    def recorder_gap(self, recorder: str) -> str:
        """Only in logs, never put: Gap, the messages that are missing there."""
        return f"{self.root}/recorder/{recorder}/gap"

    def recorder_deleted(self, recorder: str) -> str:
        """Only in logs, never put: Deletion of a key."""
        return f"{self.root}/recorder/{recorder}/deleted"

    def recorder_log(self, recorder: str) -> str:
        """Only in logs, never put: log lines and notices as foxglove.Log."""
        return f"{self.root}/recorder/{recorder}/log"
