"""Step 1 of migration, the request: a gateway says which runs are to leave it, and asks the coordinators of each.

The request is put, so that the log and whoever watches has it; the coordinators answer for their runs one by one.
"""

import time
from collections.abc import Sequence

from appliance.model import encode
from appliance.plane.node import Plane
from appliance.tasks.api import RunAsk
from appliance.tasks.executor import Here
from appliance.tasks.migration.api import MigrateAsk, Migrated, MigrationRequest, Reason
from appliance.tasks.migration.moving import Moving


class Requesting:
    """Asks for runs of this gateway to be moved away."""

    def __init__(self, plane: Plane, moving: Moving) -> None:
        self._plane = plane
        self._moving = moving

    def put(self, runs: Sequence[Here], reason: Reason, why: str) -> None:
        """Put the request for so many runs."""
        request = MigrationRequest(
            reason=reason,
            node=self._plane.gateway,
            num_containers=len(runs),
            requirements=tuple(each.request.need for each in runs),
            runs=tuple(_ask(each) for each in runs),
            why=why,
            at_ns=time.time_ns(),
        )
        self._plane.session.put(self._plane.keys.migration(self._plane.gateway), encode(request))

    async def move(self, run: Here, reason: Reason, why: str) -> Migrated:
        """Have one moved by the coordinator of its task; errors as for `Moving.migrate`."""
        ask = _ask(run)
        return await self._moving.migrate(
            MigrateAsk(task=ask.task, subtask=ask.subtask, attempt=ask.attempt, reason=reason, why=why)
        )


def _ask(run: Here) -> RunAsk:
    request = run.request
    return RunAsk(task=request.task, subtask=request.subtask, attempt=request.attempt)
