"""The arrivals of a fleet's log: each run of a subtask as its task's coordinator noted it, for the policy simulator."""

from pathlib import Path

import msgspec

from appliance.errors import ConfigError
from appliance.record.reader import read
from appliance.skills.catalogue import Catalogue, load_catalogue
from appliance.tasks.machine import Transition, TransitionKind
from workshop.simulators.pool import Arrival, Image, Trace
from workshop.simulators.pool.recorded import read_trace, trace_of

ENDS = (TransitionKind.SUCCEEDED, TransitionKind.ATTEMPT_FAILED)


def read_any(path: Path) -> Trace:
    """Read a trace from a fleet's MCAP log or from a JSONL file.

    Raises:
        ConfigError: it has no arrivals, or is neither.
        NotFoundError, RecordError: no such log, or a damaged one.
    """
    return read_log(path, load_catalogue()) if path.suffix == ".mcap" else read_trace(path)


def read_log(path: Path, catalogue: Catalogue) -> Trace:
    """Return the runs that a log tells of: images by their skills, gateways numbered as they come up.

    A run without an end in the log, or of a skill that is not in the catalogue, is left out.
    """
    decoder = msgspec.json.Decoder(Transition)
    skills: dict[tuple[str, str], str] = {}
    began: dict[tuple[str, str, int], Transition] = {}
    gateways: dict[str, int] = {}
    arrivals: list[Arrival] = []
    for message in read(path, keys="**/task/*/transition"):
        try:
            step = decoder.decode(message.payload)
        except msgspec.DecodeError:
            continue  # not one of ours
        if step.plan is not None:
            skills |= {(step.task, each.id): each.skill for each in step.plan.subtasks}
        run = (step.task, step.subtask, step.attempt)
        if step.kind is TransitionKind.STARTED:
            began[run] = step
        elif step.kind in ENDS and (start := began.pop(run, None)) is not None:
            skill = catalogue.skills.get(skills.get(run[:2], ""))
            if skill is not None:
                arrivals.append(
                    Arrival(
                        at_s=start.at_ns / 1e9,
                        image=skill.image,
                        service_s=max(0.0, (step.at_ns - start.at_ns) / 1e9),
                        gateway=gateways.setdefault(start.gateway, len(gateways)),
                    )
                )
    if not arrivals:
        raise ConfigError(f"{path}: no run of a known skill in it")
    images = {each.image: Image(name=each.image) for each in arrivals}
    return trace_of(path.stem, arrivals, images)
