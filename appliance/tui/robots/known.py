"""All robots with what is known around them, made anew only where something has changed since the last look. Pure.

With hundreds of robots and a thousand tasks, looking through all of them for each drawing would cost more than the
drawing itself.
"""

from appliance.model import Enquiry, Lease
from appliance.tui.robots.facts import Robot, leases_of, missions, questions_of
from appliance.tui.store import Store


class KnownRobots:
    """The robots of a store, followed by its changes."""

    def __init__(self) -> None:
        self._store: Store | None = None
        self._forget()

    def _forget(self) -> None:
        self._rows: dict[str, Robot] = {}
        self._seen_robots = self._seen_tasks = 0
        self._seen = (-1, -1, -1)
        """Revisions of gateways, enquiries and stops."""
        self._arrangement = -1
        self._of_task: dict[str, dict[str, str]] = {}
        """Task -> robot -> what it does for it."""
        self._doing: dict[str, dict[str, str]] = {}
        """Robot -> task -> what it does for it; the task that began last stands last."""
        self._leases: dict[str, Lease] = {}
        self._questions: dict[str, tuple[Enquiry, ...]] = {}

    def of(self, store: Store) -> dict[str, Robot]:
        """Return the robots by name as they are now; one that is as it was is the same thing as before."""
        if store is not self._store:
            self._store = store
            self._forget()
        changes = store.robots.since(self._seen_robots)
        self._seen_robots = changes.revision
        stale = set(store.robots) if changes.whole else set(changes.changed)
        stale |= self._follow_tasks(store) | self._follow_around(store)
        rows = self._rows
        for name in stale:
            info = store.robots.get(name)
            if info is None:
                continue
            stop = store.stops.of(name)
            doing = self._doing.get(name)
            fresh = Robot(
                info=info,
                mission=next(reversed(doing.values())) if doing else "",
                stopped=stop.text if stop is not None else "",
                lease=self._leases.get(name),
                questions=self._questions.get(name, ()),
            )
            if rows.get(name) != fresh:
                rows[name] = fresh
        if self._arrangement != store.robots.arrangement:
            self._arrangement = store.robots.arrangement
            self._rows = {name: rows[name] for name in sorted(store.robots)}
        return self._rows

    def _follow_tasks(self, store: Store) -> set[str]:
        """Take over what tasks have robots do; robots that do something else by it."""
        changes = store.tasks.since(self._seen_tasks)
        self._seen_tasks = changes.revision
        gone = set(self._of_task).difference(store.tasks) if changes.whole else changes.gone
        oldest_first = changes.changed if changes.whole else reversed(changes.changed)
        stale: set[str] = set()
        for task in (*oldest_first, *gone):
            record = store.tasks.get(task)
            before, now = self._of_task.get(task, {}), missions(record) if record is not None else {}
            if now == before:
                continue
            for robot in before.keys() - now.keys():
                self._doing[robot].pop(task, None)
                if not self._doing[robot]:
                    del self._doing[robot]
            for robot, text in now.items():
                self._doing.setdefault(robot, {})[task] = text
            stale |= before.keys() | now.keys()
            if now:
                self._of_task[task] = now
            else:
                self._of_task.pop(task, None)
        return stale

    def _follow_around(self, store: Store) -> set[str]:
        """Take over leases, questions and stops; robots that are concerned."""
        gateways, enquiries, stops = self._seen
        self._seen = store.revision("gateways"), store.revision("enquiries"), store.revision("stops")
        stale: set[str] = set()
        if self._seen[0] != gateways:
            leases = leases_of(store.gateways.values())
            stale |= {robot for robot in leases.keys() | self._leases if leases.get(robot) != self._leases.get(robot)}
            self._leases = leases
        if self._seen[1] != enquiries:
            asked = questions_of(store.enquiries.values())
            stale |= {
                robot for robot in asked.keys() | self._questions if asked.get(robot) != self._questions.get(robot)
            }
            self._questions = asked
        if self._seen[2] != stops:
            stale.update(store.robots)
        return stale
