"""The books of the pool as the planner sees them: facts without a way to change anything."""

from collections import Counter
from collections.abc import Iterable

from appliance.model import ContainerState
from appliance.pool.books import Books
from appliance.pool.policies import ColdCosts, Idle, View


def glance(
    books: Books, costs: ColdCosts, *, now: float, budget_mb: int, capacity: int, blocked: Iterable[str]
) -> View:
    """Return what there is.

    Args:
        books: who has which container.
        costs: what a cold start of each image costs, for containers that were adopted.
        now: the clock that runs are timed by, seconds.
        budget_mb: memory that all together may take now.
        capacity: containers at most.
        blocked: images that are not to be started now.
    """
    idle: list[Idle] = []
    busy: Counter[str] = Counter()
    lasting: Counter[str] = Counter()
    starting: Counter[str] = Counter()
    for container in books:
        info = container.info
        match info.state:
            case ContainerState.READY:
                idle.append(
                    Idle(
                        id=info.id,
                        image=info.image,
                        memory_mb=info.memory_mb,
                        runs=info.runs,
                        cold_ms=info.cold_ms or costs.of(info.image),
                        since=container.idle_since,
                    )
                )
            case ContainerState.STARTING:
                starting[info.image] += 1
            case _:
                busy[info.image] += 1
                lasting[info.image] += (now - container.busy_since) * 1e3 >= costs.of(info.image)
    return View(
        idle=tuple(idle),
        busy=busy,
        lasting=lasting,
        starting=starting,
        memory_mb=books.memory_mb,
        containers=len(books),
        budget_mb=budget_mb,
        capacity=capacity,
        blocked=frozenset(blocked),
    )
