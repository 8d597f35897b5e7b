"""Builds the graph: who does what after what, from clauses in the order in which they are said.

The annotation rules for dependencies live here. Each robot has a tail, the subtasks its next one comes after; a
sentence has a barrier, what all that newly starts in it comes after, and a thread, the list of commands that is being
given. Edges may be added freely: what follows from others is taken out at the end.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from msgspec import Struct, field

from appliance.errors import PlanError
from appliance.llm.rules.grammar import Step
from appliance.model import MAX_SUBTASKS, SPLIT, Subtask
from appliance.skills.catalogue import Catalogue


class Snapshot(Struct):
    """Where things stood before a clause, so that what runs beside it can start from there."""

    tails: dict[str, frozenset[int]]
    thread: frozenset[int]
    barrier: frozenset[int]


class Graph:
    """Subtasks so far and what they come after."""

    def __init__(self, catalogue: Catalogue) -> None:
        self.catalogue = catalogue
        self.steps: list[tuple[str, str | None, dict[str, Any]]] = []
        self.before: list[set[int]] = []
        self._clause: list[int] = []
        self._clauses = 0
        self.tails: dict[str, frozenset[int]] = {}
        self.barrier: frozenset[int] = frozenset()
        self.thread: frozenset[int] = frozenset()
        """Last subtasks of the list of commands that is being given."""
        self.scope: set[int] = set()
        """Subtasks of this sentence that a computation in it is about."""
        self.where: dict[str, str] = {}
        self.held: dict[str, set[str]] = {}
        self.previous = self.snapshot()
        """Before the last clause."""
        self.sentence = self.snapshot()
        """Before the last sentence."""

    def snapshot(self) -> Snapshot:
        """Remember where things stand."""
        return Snapshot(dict(self.tails), self.thread, self.barrier)

    def lasts(self, nodes: Iterable[int] | None = None) -> frozenset[int]:
        """Return those of `nodes` (default all) that none of them comes after."""
        chosen = set(range(len(self.steps)) if nodes is None else nodes)
        earlier = {other for node in chosen for other in self.before[node]}
        return frozenset(chosen - earlier)

    def new_sentence(self, *, parallel: bool) -> Snapshot | None:
        """Begin a sentence; a parallel one starts from where the one before it started."""
        start = self.sentence
        self.scope = set()
        self.thread = frozenset()
        self.barrier = frozenset()
        self.sentence = self.snapshot()
        if parallel:
            self.barrier = start.barrier
            return start
        return None

    def add(
        self,
        robots: Sequence[str | None],
        steps: Sequence[Step],
        *,
        beside: Snapshot | None = None,
        list_item: bool = True,
    ) -> tuple[set[int], set[int]]:
        """Add one clause for each of `robots`; return its first and its last subtasks.

        Args:
            robots: who does it; `[None]` when only computations are in it.
            steps: what is done, in order.
            beside: run in parallel to what came after this point.
            list_item: it continues the list of commands being given.
        """
        start = beside or self.snapshot()
        self.previous = self.snapshot() if beside is None else beside
        self._clauses += 1
        firsts: set[int] = set()
        ends: set[int] = set()
        added: set[int] = set()
        chains: dict[str, frozenset[int]] = {}
        shared: frozenset[int] = frozenset()
        for position, step in enumerate(steps):
            manifest = self.catalogue.skills.get(step.skill)
            compute = manifest is not None and manifest.runs == "compute"
            doers: list[str | None] = [None] if compute else list(robots)
            if manifest is not None and manifest.joint and not compute:
                doers = [next(iter(step.params["robots"]), None)]
            news: set[int] = set()
            for robot in doers:
                if robot is None:
                    after = self._computing(step, start, ends, list_item=list_item or position > 0)
                    node = self._node(step, None, after)
                    nodes = [node]
                else:
                    after = chains.get(robot)
                    if after is None:
                        after = start.tails.get(robot, frozenset()) | start.barrier
                        gateway = {each for each in start.thread if self.steps[each][1] is None}
                        after |= frozenset(gateway) if list_item else frozenset()
                    after |= shared
                    nodes = self._robot_steps(step, robot, after)
                    members = step.params.get("robots", [robot])
                    if len(members) > 1:
                        for other in members:
                            self.before[nodes[0]] |= (
                                start.tails.get(other, frozenset()) if other not in chains else chains[other]
                            )
                    for member in members:
                        chains[member] = frozenset({nodes[-1]})
                if position == 0:
                    firsts.add(nodes[0])
                news.add(nodes[-1])
                added.update(nodes)
            shared = frozenset(news) if compute else frozenset()
            ends = news
        for robot, tail in chains.items():
            self.tails[robot] = tail | (self.tails.get(robot, frozenset()) if beside is not None else frozenset())
        self.thread = frozenset(ends) | (self.thread if beside is not None else frozenset())
        self.scope |= added
        return firsts, ends

    def order(self, earlier: Iterable[int], later: Iterable[int]) -> None:
        """Make each of `later` come after each of `earlier`, unless that would close a circle."""
        for node in later:
            for other in earlier:
                if node != other and node not in self._ancestors(other):
                    self.before[node].add(other)

    def subtasks(self) -> tuple[Subtask, ...]:
        """Return the plan's subtasks with direct dependencies only, in an order in which they can run."""
        reach = [self._ancestors(node) for node in range(len(self.steps))]
        order: list[int] = []
        waiting = list(range(len(self.steps)))
        while waiting:
            ready = next(node for node in waiting if not reach[node] - set(order))
            order.append(ready)
            waiting.remove(ready)
        name = {node: f"s{index + 1}" for index, node in enumerate(order)}
        result: list[Subtask] = []
        for node in order:
            direct = {
                each
                for each in self.before[node]
                if not any(each in reach[other] for other in self.before[node] if other != each)
            }
            skill, robot, params = self.steps[node]
            result.append(
                Subtask(
                    id=name[node],
                    skill=skill,
                    robot=robot,
                    params=params,
                    after=tuple(name[each] for each in sorted(direct)),
                )
            )
        return tuple(result)

    def _ancestors(self, node: int) -> set[int]:
        found: set[int] = set()
        queue = list(self.before[node])
        while queue:
            current = queue.pop()
            if current not in found:
                found.add(current)
                queue += self.before[current]
        return found

    def _node(self, step: Step, robot: str | None, after: Iterable[int]) -> int:
        if len(self.steps) >= MAX_SUBTASKS:
            text = f"the instruction asks for more than {MAX_SUBTASKS} subtasks, which is the most a plan may have"
            raise PlanError(text, remedy=SPLIT, oversize=True)
        self.steps.append(
            (step.skill, robot, {key: value for key, value in step.params.items() if not key.startswith("_")})
        )
        self.before.append(set(after))
        self._clause.append(self._clauses)
        return len(self.steps) - 1

    def _robot_steps(self, step: Step, robot: str, after: frozenset[int]) -> list[int]:
        """Add a step with the way there and the picking up that it implies."""
        nodes: list[int] = []
        held = self.held.setdefault(robot, set())
        thing = step.params.get("object", "")
        manifest = self.catalogue.skills.get(step.skill)
        takes = manifest is not None and "load" in manifest.ties
        if takes and thing in held and step.fetch:
            return [max(after)] if after else [self._node(step, robot, after)]
        if not takes and step.fetch and thing not in held:
            nodes.append(self._node(Step("pick", {"object": thing}), robot, after))
            after = frozenset(nodes[-1:])
        if step.at and self.where.get(robot) != step.at:
            nodes.append(self._node(Step("goto", {"place": step.at}), robot, after))
            after = frozenset(nodes[-1:])
            self.where[robot] = step.at
        nodes.append(self._node(step, robot, after))
        if step.skill == "goto":
            self.where[robot] = str(step.params["place"])
        elif manifest is not None and "position" in manifest.prepares:
            self.where[robot] = str(step.params.get("place") or step.params.get("station") or "")
        if takes:
            held.add(thing)
        elif manifest is not None and "load" in manifest.frees:
            held.discard(thing)
            if step.skill == "handover":
                self.held.setdefault(str(step.params.get("to", "")), set()).add(thing)
        return nodes

    def _computing(self, step: Step, start: Snapshot, ends: set[int], *, list_item: bool) -> set[int]:
        """Return what a computation comes after: the list it stands in, the barrier, its data."""
        after = set(start.barrier)
        if ends:
            return after | ends
        if self._gathers(step.skill):
            return after | (self.lasts(self.scope) if self.scope and list_item else self.lasts())
        if list_item:
            after |= start.thread
        if not step.params.get("source"):
            after |= self._producers(step.skill)
        return after

    def _gathers(self, skill: str) -> bool:
        """Whether a computation is about all that was done, not about one product."""
        manifest = self.catalogue.skills.get(skill)
        return manifest is not None and (manifest.reports or len(manifest.feeds_on) > 1)

    def _producers(self, skill: str) -> set[int]:
        """Return the subtasks of the latest clause that makes what a computation consumes."""
        wanted = set(self.catalogue.skills[skill].consumes) if skill in self.catalogue.skills else set[str]()
        makers = [
            node
            for node, (made, _, _) in enumerate(self.steps)
            if made in self.catalogue.skills and wanted & set(self.catalogue.skills[made].produces)
        ]
        latest = max((self._clause[node] for node in makers), default=0)
        return {node for node in makers if self._clause[node] == latest}


class Mentions(Struct):
    """What was spoken of last, for pronouns."""

    thing: str = ""
    held: str = ""
    """What was picked last and not put down or given away since."""
    place: str = ""
    person: str = ""
    model: str = ""
    robots: list[str] = field(default_factory=list[str])
    group: list[str] = field(default_factory=list[str])
