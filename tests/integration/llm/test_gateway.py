"""The planner through a gateway's verbs, on real planes: bad input, models of other gateways, and the closed loop.

The planes, the task managers, the planner and the model's process are real. Containers and robots are not: a stand-in
for the executor ends each run at once, as the test wants it.
"""

import asyncio
import importlib.util
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.errors import PayloadError, PlanError, SwiftbotError, UnreachableError
from appliance.llm.cascade import Decomposer
from appliance.llm.peers import PeerTier
from appliance.llm.settings import LlmConfig, SafetyConfig
from appliance.model import (
    Failure,
    GatewayStatus,
    Phase,
    Place,
    PlannerStatus,
    PoolHint,
    RobotInfo,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    Site,
    SlotStatus,
    TaskRecord,
    TaskRequest,
    TaskState,
    Tier,
    encode,
    keyspace,
)
from appliance.model.planner_api import ProposeAsk, Proposed
from appliance.model.pool_api import Hinted
from appliance.model.task_api import ExperienceAsk, PlanAnswer, PlanAsk, TaskAsk
from appliance.plane.client import PlaneClient
from appliance.plane.node import Plane
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.skills.catalogue import load_catalogue
from appliance.tasks.manager import TaskManager
from appliance.tasks.settings import TasksConfig

pytestmark = pytest.mark.anyio

CATALOGUE = load_catalogue()
_USES = tuple(sorted({use for skill in CATALOGUE.skills.values() for use in skill.uses}))
_VERBS = tuple(sorted({verb for skill in CATALOGUE.skills.values() for verb in skill.verbs}))
SITE = Site(places={f"dock {number}": Place(x=number, y=1) for number in (1, 2, 3)} | {"shelf": Place(x=5, y=5)})
LONG_S = 60.0
"""Nothing here takes so long; the machine may be busy."""


class Runs:
    """A stand-in for the executor: accepts each run and publishes its end at once, as `fails` says."""

    def __init__(self, plane: Plane) -> None:
        self.plane = plane
        self.fails: Callable[[RunRequest], Failure | None] = lambda _: None
        self.took_ms: Callable[[RunRequest], float] = lambda _: 10.0
        self.done: list[tuple[str, str | None]] = []

    async def run(self, request: RunRequest) -> RunAccepted:
        """Accept a run; it ends a moment later."""
        self.done.append((request.skill, request.robot))
        asyncio.get_running_loop().call_later(0.01, self._end, request)
        return RunAccepted(gateway=self.plane.gateway, container="c1", phase=Phase.LOCAL_WARM)

    def _end(self, request: RunRequest) -> None:
        failure = self.fails(request)
        common: dict[str, Any] = {
            "task": request.task, "subtask": request.subtask, "attempt": request.attempt,
            "gateway": self.plane.gateway, "container": "c1", "phase": Phase.LOCAL_WARM,
        }  # fmt: skip
        ended = (
            RunEvent(kind=RunEventKind.SUCCEEDED, result={}, duration_ms=self.took_ms(request), **common)
            if failure is None
            else RunEvent(kind=RunEventKind.FAILED, failure=failure, **common)
        )
        key = self.plane.keys(keyspace.RUN_EVENT, request.task, request.subtask)
        for event in (RunEvent(kind=RunEventKind.STARTED, **common), ended):
            self.plane.session.put(key, encode(event))

    async def hint(self, hint: PoolHint) -> Hinted:
        """Follow no hint."""
        return Hinted(taken=False, why=f"no pool for {hint.image}")


class Gate:
    """One gateway of the test: plane, planner, tasks."""

    def __init__(self, plane: Plane, config: LlmConfig, safety: SafetyConfig) -> None:
        async def ask(gateway: str, asked: ProposeAsk, timeout_s: float) -> Proposed:
            return await plane.rpc.call(gateway, keyspace.PROPOSE, asked, timeout_s=timeout_s)

        peers = PeerTier(config, gateways=lambda: plane.registry.gateways, ask=ask, here=plane.gateway)
        self.plane = plane
        self.runs = Runs(plane)
        self.decomposer = Decomposer(config, CATALOGUE, safety=safety, gateway=plane.gateway, peers=peers)
        self.tasks = TaskManager(
            TasksConfig(check_s=0.2),
            plane=plane,
            catalogue=CATALOGUE,
            decomposer=self.decomposer,
            site=SITE,
        )

    async def start(self) -> None:
        """Answer."""
        memory = self.decomposer.memory
        await memory.load(self.plane.store)
        await self.decomposer.start()
        self.plane.session.subscribe(
            self.plane.keys(keyspace.TASK_UPDATE), lambda message: memory.hear(message.key, message.payload)
        )
        self.plane.rpc.register(keyspace.PROPOSE, self.decomposer.propose)
        self.plane.rpc.register(keyspace.RUN, self.runs.run)
        await self.tasks.start()
        self.tell()

    def tell(self) -> None:
        """Publish its status."""
        status = GatewayStatus(
            id=self.plane.gateway, fleet="f", capacity=8, ready=8, cores=8, planner=self.decomposer.status
        )
        self.plane.registry.publish_status(status)

    async def stop(self) -> None:
        """End."""
        await self.tasks.stop()
        await self.decomposer.close()
        await self.plane.close()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    """A tiny model of random weights that writes the plan language."""
    spec = importlib.util.spec_from_file_location("tiny_model", project_root / "tests" / "tiny_model.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.build(tmp_path_factory.mktemp("speaks") / "tiny", speaks=CATALOGUE)


@pytest.fixture
async def start(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Callable[..., Any]]:
    """Return a function that starts gateways with these planners, a roster of two robots, and a client."""
    gates: list[Gate] = []
    closers: list[Callable[[], Any]] = []

    async def make(*configs: LlmConfig, safety: SafetyConfig | None = None) -> SimpleNamespace:
        endpoints = [f"tcp/127.0.0.1:{port}" for port in free_ports(len(configs))]
        for number, config in enumerate(configs):
            plane_config = PlaneConfig(listen=(endpoints[number],), connect=tuple(endpoints[:number]))
            plane = await Plane.open(plane_config, fleet="f", gateway=f"g{number}", data_dir=tmp_path / f"g{number}")
            gate = Gate(plane, config, safety or SafetyConfig(choose_robot="auto"))
            gates.append(gate)
            await gate.start()
        client_config = PlaneConfig(mode="client", connect=(endpoints[0],), connect_timeout_s=5)
        robots = await Session.open(client_config, "f")
        closers.append(robots.close)
        for name in ("rover_1", "rover_2"):
            robots.declare_alive(robots.keys(keyspace.ROBOT_ALIVE, name))
            info = RobotInfo(id=name, kind="zenoh", uses=_USES, verbs=_VERBS)
            await until(lambda name=name: all(name in each.plane.registry.robots for each in gates), robots, info)
        client = await PlaneClient.open(client_config, fleet="f")
        closers.append(client.close)
        return SimpleNamespace(gates=gates, client=client)

    yield make
    for close in reversed(closers):
        await close()
    for gate in reversed(gates):
        await gate.stop()


async def until(so: Callable[[], bool], robots: Session | None = None, info: RobotInfo | None = None) -> None:
    """Wait until something is so, telling of a robot meanwhile."""
    give_up = time.monotonic() + LONG_S
    while not so():
        if robots is not None and info is not None:
            robots.put(robots.keys(keyspace.ROBOT, info.id), encode(info))
        assert time.monotonic() < give_up
        await asyncio.sleep(0.02)


async def carried_out(fleet: SimpleNamespace, task: str, instruction: str) -> TaskRecord:
    """Hand a task in and wait for its end."""
    request = TaskRequest(instruction=instruction, id=task)
    await fleet.client.rpc.call("g0", keyspace.SUBMIT, request, timeout_s=10.0)
    give_up = time.monotonic() + LONG_S
    while True:
        record = await fleet.client.rpc.call("g0", keyspace.TASK, TaskAsk(id=task), timeout_s=10.0)
        if record.state.final:
            return record
        assert time.monotonic() < give_up, record
        await asyncio.sleep(0.05)


# --- bad input ------------------------------------------------------------------------------------------------------

BAD = (
    ("", "empty"),
    ("   ", "empty"),
    ("x" * 100_000, "characters"),
    ("\x00\x01\x02\x03\x04binary\x00", "binary data"),
    ('{"domain": "navigation", "subtasks": [{"id": "s1"}]}', "data (JSON"),
    ("geh zum Dock 1 und hole die Kiste", "looks like German"),
    ("иди к доку", "only English"),
    ("what is love", "question"),
    ("fly the forklift", "no skill flies forklift"),
    ("colourless green ideas sleep furiously", "not understood"),
    ("Rover_9: go to dock 1", "there is no robot rover_9"),
    ("Rover_1: go to the moon", "there is no place moon"),
)


@pytest.mark.parametrize(("text", "said"), BAD, ids=range(len(BAD)))
async def test_bad_input_through_the_gateways_verbs(start: Callable[..., Any], text: str, said: str) -> None:
    """A clear answer that says why, by `plan` and as the failure of a task; nothing runs."""
    fleet = await start(LlmConfig(tiers=("rules",)))
    with pytest.raises((PlanError, PayloadError)) as caught:
        await fleet.client.rpc.call("g0", keyspace.PLAN, PlanAsk(instruction=text), timeout_s=20.0)
    assert said in caught.value.message
    if isinstance(caught.value, PlanError):
        record = await carried_out(fleet, "t-bad", text)
        assert record.state is TaskState.FAILED
        assert record.failure is not None
        assert said in record.failure.message
    assert fleet.gates[0].runs.done == []


# --- a model on another gateway -------------------------------------------------------------------------------------


def sure_of_nothing(**more: Any) -> dict[str, Any]:
    """Return settings that take any model's plan."""
    return {"run_confidence": 0.0, "show_confidence": 0.0, "require_implemented": False, **more}


async def test_a_gateway_without_a_model_asks_one_that_has(start: Callable[..., Any], model: Path) -> None:
    """What g1's model makes of it is g0's answer, with where it came from; a private instruction is not sent there."""
    without = LlmConfig(tiers=("peer", "rules"), **sure_of_nothing())
    having = LlmConfig(tiers=("local",), local_model=str(model), **sure_of_nothing(local_deadline_s=60.0))
    fleet = await start(without, having)
    g0, g1 = fleet.gates

    def known() -> bool:
        g1.tell()
        planner = g0.plane.registry.gateways["g1"].planner if "g1" in g0.plane.registry.gateways else None
        return planner is not None and planner.slot is not None and planner.slot.state == "ready"

    await until(known)
    texts = [f"Rover_1: go to dock {number}" for number in (1, 2, 3)] + ["Rover_2: hold", "Rover_1: land"]
    answers: list[PlanAnswer | SwiftbotError] = []
    for text in texts:
        try:
            answers.append(await fleet.client.rpc.call("g0", keyspace.PLAN, PlanAsk(instruction=text)))
        except PlanError as error:
            answers.append(error)
    asked = g1.decomposer.status.slot
    assert asked is not None
    assert asked.answered >= len(texts)
    told = [each for each in answers if isinstance(each, PlanAnswer)]
    # Random weights: some answers are plans, some are none; then the rules have planned.
    assert all(each.attempts[0].tier == "peer" for each in told)
    for each in told:
        first = each.plan.provenance
        assert first is not None
        assert (first.gateway, first.model) == (("g1", "tiny") if each.plan.tier is Tier.PEER else ("g0", ""))
    before = asked.answered
    private = PlanAsk(instruction="Rover_1: go to dock 1", private=True)
    answer = await fleet.client.rpc.call("g0", keyspace.PLAN, private)
    assert answer.plan.tier is Tier.RULES
    assert "private" in answer.attempts[0].problems[0]
    slot = g1.decomposer.status.slot
    assert slot is not None
    assert slot.answered == before


async def test_when_the_other_gateway_goes_the_rules_answer(start: Callable[..., Any]) -> None:
    """A gateway that says it has a model and does not answer costs its deadline once, then it is left alone."""
    config = LlmConfig(tiers=("peer", "rules"), peer_deadline_s=0.3, peer_tries=1, require_implemented=False, cache=0)
    fleet = await start(config, LlmConfig(tiers=("rules",), require_implemented=False))
    g0, g1 = fleet.gates
    pretended = PlannerStatus(slot=SlotStatus(model="m", state="ready"))
    g1.plane.registry.publish_status(GatewayStatus(id="g1", fleet="f", planner=pretended))
    await until(lambda: cast("Any", g0.decomposer)._slots[0].planner.present)
    for number in range(3):
        asked = PlanAsk(instruction=f"Rover_1: go to dock {1 + number}")
        answer = await fleet.client.rpc.call("g0", keyspace.PLAN, asked, timeout_s=30.0)
        assert answer.plan.tier is Tier.RULES
        assert "no other gateway's model answered" in answer.attempts[0].problems[0]
    with pytest.raises((UnreachableError, SwiftbotError)):
        await g0.plane.rpc.call("g1", keyspace.PROPOSE, ProposeAsk(instruction="go home"))


# --- the closed loop ------------------------------------------------------------------------------------------------

SLIPPED = Failure(code="robot", message="the gripper slipped")


async def test_a_skill_that_keeps_failing_on_a_robot_is_given_to_another(start: Callable[..., Any]) -> None:
    """rover_1 is asked first until picking has failed on it often enough; then rover_2 is, though nobody named it."""
    fleet = await start(LlmConfig(tiers=("rules",), require_implemented=False, cache=0))
    (gate,) = fleet.gates
    gate.runs.fails = lambda run: SLIPPED if run.skill == "pick" and run.robot == "rover_1" else None
    firsts: list[str | None] = []
    for number in range(4):
        gate.runs.done.clear()
        record = await carried_out(fleet, f"t-{number}", "pick the box")
        assert record.state is TaskState.SUCCEEDED
        firsts.append(gate.runs.done[0][1])
    assert firsts[0] == "rover_1"
    assert firsts[-1] == "rover_2"
    told = await fleet.client.rpc.call("g0", keyspace.EXPERIENCE, ExperienceAsk(), timeout_s=10.0)
    by_robot = {row.robot: row for row in told.rows if row.skill == "pick"}
    assert by_robot["rover_1"].shunned
    assert not by_robot["rover_2"].shunned
    assert "slipped" in by_robot["rover_1"].why
    # An operator who names the robot gets it all the same: the operator's word counts for more than experience.
    gate.runs.done.clear()
    await carried_out(fleet, "t-named", "Rover_1: pick the box")
    assert gate.runs.done[0] == ("pick", "rover_1")


async def test_expected_durations_converge_and_the_next_analysis_tells_them(start: Callable[..., Any]) -> None:
    """What runs take is what the next plan is expected to take."""
    fleet = await start(LlmConfig(tiers=("rules",), require_implemented=False))
    (gate,) = fleet.gates
    gate.runs.took_ms = lambda _: 7000.0
    asked = PlanAsk(instruction="Rover_1: pick the box")

    async def expected() -> float:
        answer = await fleet.client.rpc.call("g0", keyspace.PLAN, asked, timeout_s=20.0)
        return answer.analysis.expected_s

    before = await expected()
    for number in range(3):
        await carried_out(fleet, f"t-{number}", "Rover_1: pick the box")
    await until(lambda: gate.decomposer.memory.experience.expected_s("pick", "rover_1") == 7.0)
    assert before != 7.0
    assert await expected() == 7.0


async def test_a_plan_that_succeeded_comes_from_the_cache_and_leaves_it_when_it_fails(
    start: Callable[..., Any],
) -> None:
    """The second time the same words get the same plan at once, and the record says why; a failure forgets it."""
    fleet = await start(LlmConfig(tiers=("rules",), require_implemented=False))
    (gate,) = fleet.gates
    first = await carried_out(fleet, "t-1", "Rover_1: go to dock 1, then pick the box")
    assert first.plan is not None
    assert first.plan.tier is Tier.RULES
    await until(lambda: gate.decomposer.memory.cache.figures.entries == 1)
    again = await carried_out(fleet, "t-2", "rover_1:  go to dock 1, then pick the box.")
    assert again.plan is not None
    assert again.plan.provenance is not None
    assert again.plan.tier is Tier.CACHE
    assert again.plan.subtasks == first.plan.subtasks
    assert "planned by rules, carried out with success once" in again.plan.provenance.cache
    assert again.plan.provenance.gateway == "g0"
    gate.runs.fails = lambda run: SLIPPED if run.skill == "pick" else None
    failed = await carried_out(fleet, "t-3", "Rover_1: go to dock 1, then pick the box")
    assert failed.state is TaskState.FAILED
    await until(lambda: gate.decomposer.memory.cache.figures.entries == 0)


async def test_a_plan_that_nobody_is_sure_of_waits_for_the_operator(start: Callable[..., Any]) -> None:
    """With words that its plan does not account for a task waits as proposed, with the words; nothing has run."""
    config = LlmConfig(tiers=("rules",), require_implemented=False, show_confidence=0.0)
    fleet = await start(config)
    (gate,) = fleet.gates
    request = TaskRequest(instruction="Rover_1: go to dock 1. Abracadabra simsalabim hocus pocus.", id="t-1")
    await fleet.client.rpc.call("g0", keyspace.SUBMIT, request, timeout_s=10.0)
    give_up = time.monotonic() + LONG_S
    while True:
        record = await fleet.client.rpc.call("g0", keyspace.TASK, TaskAsk(id="t-1"), timeout_s=10.0)
        if record.state is TaskState.PROPOSED:
            break
        assert time.monotonic() < give_up, record
        await asyncio.sleep(0.05)
    assert record.proposal is not None
    assert "abracadabra" in record.proposal.note
    assert gate.runs.done == []
