"""The newest tasks of a fleet or of one gateway's shard: what `swiftbot task list` and the terminal UI ask for."""

import asyncio
import contextlib
from collections.abc import Iterable

from msgspec.structs import replace

from appliance.errors import PayloadError, SwiftbotError
from appliance.model import TaskRecord
from appliance.plane.node import Plane
from appliance.tasks.api import TaskList, TasksAsk
from appliance.tasks.bounds import read_record
from appliance.tasks.remembering import TRIMMED
from appliance.tasks.surroundings import PREFIX

ANSWER_S = 2.0


async def newest_tasks(plane: Plane, ask: TasksAsk, driven: Iterable[TaskRecord]) -> TaskList:
    """Return the newest tasks; gateways that do not answer in time are named.

    Args:
        plane: the fleet.
        ask: how many, and whether of this gateway's shard alone.
        driven: records of tasks that are driven here, which may be newer than those written.
    """
    found: dict[str, TaskRecord] = {}
    # Without what is only remembered: there is too much of it to be shown, or read, each time.
    for stored in await plane.dht.local(PREFIX, leave_out=TRIMMED):
        if not stored.deleted:
            with contextlib.suppress(PayloadError):
                record = read_record(stored.value)
                found[record.id] = record
    found.update({record.id: record for record in driven})
    unreachable: list[str] = []
    if not ask.local:
        others = sorted(plane.members() - {plane.gateway})
        here = replace(ask, local=True)
        answers = await asyncio.gather(
            *(plane.rpc.call(other, "tasks", here, TaskList, timeout_s=ANSWER_S) for other in others),
            return_exceptions=True,
        )
        for other, answer in zip(others, answers, strict=True):
            if isinstance(answer, TaskList):
                for record in answer.tasks:
                    if record.id not in found or found[record.id].sequence < record.sequence:
                        found[record.id] = record
            elif isinstance(answer, SwiftbotError):
                unreachable.append(other)
            else:
                raise answer
    newest = sorted(found.values(), key=lambda record: (record.created_ns, record.id), reverse=True)
    return TaskList(tasks=tuple(newest[: max(0, ask.limit)]), unreachable=tuple(unreachable))
