"""Placements as they are told for the log: all that the choice of a gateway rested on, so that it can be made again.

Only of subtasks that were sent: one that waits is placed anew several times a second. Gateways that were no candidates
are left out, since they have no part in the order; so are containers that were not ready.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from msgspec import Struct

from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    Need,
    RobotInfo,
    SubtaskRecord,
    TaskRecord,
    encode,
)
from appliance.plane.node import Plane
from appliance.tasks.placement import Placement, place
from appliance.tasks.settings import TasksConfig

MOST_GATEWAYS = 64
"""Candidates that are told of one placement; a group has eight."""


class Seen(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A candidate as its coordinator knew it."""

    id: str
    load: float = 0.0
    overloaded: bool = False
    problem: str = ""
    ready: tuple[tuple[str, ...], ...] = ()
    """Its ready containers: the image of each, and those it is compatible with."""


class PlacementCase(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One placement, put as `gw/{gateway}/decided/placement` when the subtask is sent."""

    task: str
    subtask: str
    attempt: int
    need: Need
    here: str
    gateways: tuple[Seen, ...]
    holds: dict[str, float] = {}
    robot_at: str | None = None
    """Gateway of the robot's link; None: it commands no robot."""
    avoid: tuple[str, ...] = ()
    stale_s: dict[str, float] = {}
    load_weight: float
    data_weight: float
    warm_weight: float
    order: tuple[str, ...]
    scores: dict[str, float]


class Asked(Struct, frozen=True, kw_only=True):
    """What a placement was made from, by reference: looked at only if the subtask is sent, before anything moves."""

    need: Need
    here: str
    gateways: Mapping[str, GatewayStatus]
    containers: Mapping[str, Mapping[str, ContainerInfo]]
    holds: Mapping[str, float]
    robot: RobotInfo | None
    avoid: frozenset[str]
    stale_s: Mapping[str, float]
    config: TasksConfig


def placement_case(
    placement: Placement, asked: Asked, record: TaskRecord, target: SubtaskRecord
) -> PlacementCase | None:
    """Return a placement with all that it rested on; None when there are too many candidates to tell."""
    if len(placement.order) > MOST_GATEWAYS:
        return None
    return PlacementCase(
        task=record.id,
        subtask=target.subtask.id,
        attempt=target.next_attempt,
        need=asked.need,
        here=asked.here,
        gateways=tuple(
            Seen(
                id=name,
                load=asked.gateways[name].load,
                overloaded=bool(asked.gateways[name].overloaded),
                problem=asked.gateways[name].pool_problem,
                ready=_ready(asked.containers.get(name, {}).values()),
            )
            for name in sorted(placement.order)
        ),
        holds=dict(asked.holds),
        robot_at=None if asked.robot is None else asked.robot.gateway,
        avoid=tuple(sorted(asked.avoid)),
        stale_s={name: late_s for name, late_s in asked.stale_s.items() if name in placement.scores},
        load_weight=asked.config.load_weight,
        data_weight=asked.config.data_weight,
        warm_weight=asked.config.warm_weight,
        order=placement.order,
        scores=placement.scores,
    )


def _ready(containers: Iterable[ContainerInfo]) -> tuple[tuple[str, ...], ...]:
    kinds = {(each.image, *each.compatible) for each in containers if each.state is ContainerState.READY}
    return tuple(sorted(kinds))


def tell(plane: Plane, case: PlacementCase | None) -> None:
    """Put a placement, for the log."""
    if case is not None:
        plane.session.put(plane.keys.decided(plane.gateway, "placement"), encode(case))


def place_again(case: PlacementCase) -> dict[str, Any]:
    """Return what the placement is now, by the names of the case's fields."""
    containers = {
        each.id: {
            str(number): ContainerInfo(
                id=str(number), gateway=each.id, image=kind[0], compatible=kind[1:], state=ContainerState.READY
            )
            for number, kind in enumerate(each.ready)
        }
        for each in case.gateways
    }
    placement = place(
        case.need,
        here=case.here,
        gateways={
            each.id: GatewayStatus(
                id=each.id,
                fleet="",
                load=each.load,
                overloaded="is overloaded" if each.overloaded else "",
                pool_problem=each.problem,
            )
            for each in case.gateways
        },
        containers=containers,
        holds=case.holds,
        robot=None if case.robot_at is None else RobotInfo(id="robot", kind="", gateway=case.robot_at),
        avoid=frozenset(case.avoid),
        config=TasksConfig(load_weight=case.load_weight, data_weight=case.data_weight, warm_weight=case.warm_weight),
        stale_s=case.stale_s,
    )
    return {"order": placement.order, "scores": placement.scores}
