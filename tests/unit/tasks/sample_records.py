"""Records, plans, manifests and events as tests of tasks begin with."""

from typing import Any, cast

from appliance.model import Plan, RunEvent, RunEventKind, RunRequest, Subtask, TaskRecord
from appliance.skills.catalogue import Catalogue, SkillManifest
from appliance.tasks import machine
from appliance.tasks.machine import Transition, TransitionKind


def event(request: RunRequest, kind: RunEventKind, **fields: Any) -> RunEvent:
    """Return an event of a run."""
    return RunEvent(
        **{"task": request.task, "subtask": request.subtask, "attempt": request.attempt, "kind": kind, **fields}
    )


def manifest(skill: str = "work", **fields: Any) -> SkillManifest:
    """Return a skill's manifest."""
    return SkillManifest(
        **{"id": skill, "domain": "any", "summary": "works", "runs": "compute", "image": "base", "retries": 1, **fields}
    )


CATALOGUE = cast("Catalogue", type("C", (), {"skills": {"work": manifest()}, "domains": ("any",), "images": {}})())


def plan_of(*subtasks: Subtask) -> Plan:
    """Return a plan; by default of one subtask s1."""
    return Plan(domain="any", subtasks=subtasks or (Subtask(id="s1", skill="work"),))


def accepted(task: str = "t-1", plan: Plan | None = None, coordinator: str = "gw-1") -> TaskRecord:
    """Return a record just accepted."""
    return machine.apply(
        None,
        Transition(
            task=task,
            sequence=1,
            kind=TransitionKind.ACCEPTED,
            at_ns=1,
            coordinator=coordinator,
            instruction="work",
            plan=plan,
        ),
    )
