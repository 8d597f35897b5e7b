"""What a plain Zenoh client once did to a fleet, tried again on real gateways and a vehicle: nothing of it is done.

Each attacker speaks Zenoh without this product's code, which would refuse most of it by itself.
"""

import asyncio
import time
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest
import zenoh
from fleets import fleet_in

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.identity.authority import Authority
from appliance.identity.signing import Signer
from appliance.model import (
    Act,
    GatewayStatus,
    Lifted,
    RobotCommand,
    RobotInfo,
    RunEvent,
    RunEventKind,
    TaskRecord,
    TaskRequest,
    TaskState,
    encode,
    keyspace,
)
from appliance.model.keys import Keys
from appliance.model.plane_api import Record, RecordChange, StoreAsk, Write
from appliance.model.robot_api import ResumeRobotsAsk, StopAsk
from appliance.model.roles import Role
from appliance.model.steering import Approval
from appliance.model.task_api import ApproveAsk, DrainAsk
from appliance.model.transfer_api import FetchAsk
from appliance.plane import link
from appliance.plane.settings import PlaneConfig
from workshop.local_fleet import keys_folder

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]

FORGED = {"forged": True}
COUNTED = ("gw/gw-1/rpc/approve", "gw/gw-1/rpc/soft_resume", "robot/drone_1/command")


@pytest.fixture(scope="module")
async def state(anyio_backend: str, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[FleetState]:
    """A gateway, a recorder and a vehicle, all links with keys."""
    async with fleet_in(
        tmp_path_factory.mktemp("attacked"), gateways=1, mavlink=1, zenoh=0, sim_rate=4.0, secured=True
    ) as found:
        yield found


class Attacker:
    """A member of the fleet that wants more than it may."""

    def __init__(self, fleet: FleetState, role: Role, name: str) -> None:
        authority = Authority.load(keys_folder(Path(fleet.directory)))
        keys = authority.folder / f"{role}-{name}.pem"
        authority.issue(role, name, out=keys)
        config = PlaneConfig(mode="client", connect=(fleet.endpoints[0],), keys=str(keys))
        found = link.read_credentials(config, fleet.fleet)
        assert found is not None
        self.signer = Signer(found.bundle.key, found.bundle.certificate)
        self.raw: zenoh.Session = link.open_raw(config, "", found)
        self.keys = Keys(fleet.fleet)

    def order(self, key: str, request: msgspec.Struct, *, signer: Signer | None = None) -> str:
        """Ask for something; returns `done`, the error's code, or `nobody` where nothing answers."""
        payload = encode(request)
        signature = signer.sign(key, payload, time.time_ns()) if signer is not None else None
        attachment = None if signature is None else link.mark(key, direct=False, signature=signature)
        for reply in self.raw.get(key, payload=payload, attachment=attachment, timeout=1.0):
            return "done" if reply.err is None else msgspec.json.decode(reply.err.payload.to_bytes())["code"]
        return "nobody"

    def heard_order(self, key: str, request: msgspec.Struct, *, signer: Signer | None = None) -> str:
        """Ask until somebody answers: a session that was just opened does not know yet who does."""
        until = time.monotonic() + 20.0
        while (came := self.order(key, request, signer=signer)) == "nobody" and time.monotonic() < until:
            time.sleep(0.1)
        return came

    def orders(self, task: TaskRecord) -> dict[str, str]:
        """Order all that was once done; returns what each came to."""
        keys, of_task = self.keys, f"task/{task.id}"
        done = encode(msgspec.structs.replace(task, state=TaskState.SUCCEEDED))
        wanted: dict[str, msgspec.Struct] = {
            keys(keyspace.COMMAND, "drone_1"): RobotCommand(id="evil", verb="takeoff", args={"altitude_m": 30.0}),
            keys(keyspace.RPC, "gw-1", "approve"): ApproveAsk(id=task.id, by="ceo"),
            keys(keyspace.RPC, "gw-1", "soft_resume"): ResumeRobotsAsk(by="alice"),
            keys(keyspace.RPC, "gw-1", "record_write"): RecordChange(key=of_task, deleted=True),
            keys(keyspace.RPC, "gw-1", "dht_write"): Write(key=of_task, value=done),
            keys(keyspace.RPC, "gw-1", "dht_store"): StoreAsk(
                record=Record(key=of_task, value=done, version={"gw-1": 10**6}, write="w")
            ),
            keys(keyspace.RPC, "gw-1", "drain"): DrainAsk(by="alice"),
            keys(keyspace.RPC, "gw-1", "image_fetch"): FetchAsk(reference="localhost/evil:1", by="alice"),
        }
        return {key.removeprefix(f"{keys.root}/"): self.order(key, request) for key, request in wanted.items()}

    def puts(self, task: TaskRecord) -> None:
        """Put all that was once believed."""
        for subtask in ("s1", "s2"):
            event = RunEvent(
                task=task.id, subtask=subtask, attempt=1, kind=RunEventKind.SUCCEEDED, gateway="gw-1", result=FORGED
            )
            self.raw.put(self.keys(keyspace.RUN_EVENT, task.id, subtask), encode(event))
        flat = RobotInfo(id="drone_1", kind="mavlink", gateway="gw-1", battery_percent=2.0)
        self.raw.put(self.keys(keyspace.ROBOT, "drone_1"), encode(flat))
        self.raw.put(self.keys(keyspace.TASK_UPDATE, task.id), encode(TaskRecord(id=task.id, instruction="forged")))
        self.raw.put(self.keys(keyspace.STATUS, "gw-1"), encode(GatewayStatus(id="gw-1", fleet="evil", draining=True)))
        self.raw.put(self.keys(keyspace.LIFTED, "l-1"), encode(Lifted(id="l-1", by="alice", stops=("s-1",))))
        self.raw.delete(self.keys(keyspace.ROBOT, "drone_1"))


async def denied(client: FleetClient, enough: int) -> list[Act]:
    """Wait until so many refused orders are in the audit; returns them."""
    while True:
        found = [act for act in (await client.acts())[0] if act.outcome == "denied"]
        if len(found) >= enough:
            return found
        await asyncio.sleep(0.1)


async def let_in(robot: Attacker, client: FleetClient) -> None:
    """Wait until the fleet's gateways know a robot whose certificate is new: what it says of itself is heard."""
    state = encode(RobotInfo(id="drone_9", kind="zenoh"))
    while "drone_9" not in client.plane.registry.robots:
        robot.raw.put(robot.keys(keyspace.ROBOT, "drone_9"), state)
        await asyncio.sleep(0.1)


async def test_nothing_that_a_stranger_once_did_is_done(state: FleetState) -> None:
    """By a viewer, an operator without a signature, and another robot: the vehicle stays, the task is the fleet's own.

    What access control lets through to the gateway is counted, and is in the audit with the name in the certificate.
    """
    async with FleetClient(state.endpoint) as client:
        robot = await asyncio.to_thread(Attacker, state, Role.ROBOT, "drone_9")
        await let_in(robot, client)
        vera, olga = [
            await asyncio.to_thread(Attacker, state, role, name)
            for role, name in ((Role.VIEWER, "vera"), (Role.OPERATOR, "olga"))
        ]
        attackers = [robot, vera, olga]
        stop = await client.stop(("drone_1",))
        task = await client.submit(
            TaskRequest(instruction="drone_1 take off to 3 m", id="t-held", approval=Approval.ALWAYS)
        )
        while (task := await client.task(task.id)).state is not TaskState.PROPOSED:
            await asyncio.sleep(0.1)
        for attacker in attackers:
            came = await asyncio.to_thread(attacker.orders, task)
            assert set(came.values()) <= {"nobody", "identity"}, came
            await asyncio.to_thread(attacker.puts, task)
        approve = olga.keys(keyspace.RPC, "gw-1", "approve")
        forged = await asyncio.to_thread(olga.order, approve, ApproveAsk(id=task.id, by="ceo"), signer=vera.signer)
        assert forged == "identity"

        assert (await client.task(task.id)).state is TaskState.PROPOSED
        assert {each.id for each in (await client.standing()).active} == {each.id for each in stop.stops}
        drone = client.plane.registry.robots["drone_1"]
        assert (drone.online, drone.armed) == (True, False)
        assert drone.battery_percent != 2.0

        acts = await denied(client, 4)
        assert {(act.verb, act.by) for act in acts} >= {
            ("approve", "unproven"), ("approve", "vera"), ("soft_resume", "unproven"), ("command", "unproven"),
        }  # fmt: skip
        assert not [act for act in (await client.acts())[0] if act.by in ("ceo", "alice")]
        counted = {f"unauthorized {key}" for key in COUNTED}
        while not counted <= client.plane.registry.gateways["gw-1"].refused.keys():
            await asyncio.sleep(0.1)

        await client.resume_robots(("drone_1",))
        assert task.proposal is not None
        await client.approve(task.id, plan_hash=task.proposal.hash)
        while not task.state.final:
            for attacker in attackers:
                await asyncio.to_thread(attacker.puts, task)
            task = await client.task(task.id)
        assert task.state is TaskState.SUCCEEDED
        assert all(each.result != FORGED for each in task.subtasks)
        assert task.instruction == "drone_1 take off to 3 m"
    for attacker in attackers:
        await asyncio.to_thread(attacker.raw.close)


async def test_a_stop_of_another_name_is_in_the_audit_under_the_right_one(state: FleetState) -> None:
    """A viewer may stop, and is named; without a good signature it is carried out too, and the audit says so."""
    viola = await asyncio.to_thread(Attacker, state, Role.VIEWER, "viola")
    key = viola.keys(keyspace.RPC, "gw-1", "soft_stop")
    async with FleetClient(state.endpoint) as client:
        for signer, act in ((viola.signer, "signed"), (None, "plain")):
            ask = StopAsk(by="alice", act=act)
            assert await asyncio.to_thread(viola.heard_order, key, ask, signer=signer) == "done"
        acts = (await client.acts())[0]
        assert next(act.by for act in acts if act.id == "signed") == "viola"
        assert [(act.verb, act.by) for act in acts if act.outcome == "unverified"] == [("soft_stop", "unproven")]
        assert {each.id for each in (await client.standing()).active} >= {"signed", "plain"}
    await asyncio.to_thread(viola.raw.close)
