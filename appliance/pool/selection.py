"""Container selection in three phases (paper, Algorithm 1), as plain functions of facts.

It exists apart from the pool so that it can be property-tested and simulated: no clock, no I/O, no state. The
pool asks it with the ready containers it has, then with those others offer, and carries out what it says.

Phase 1 takes the best ready container here, if the state that the subtask asks for is here or nowhere. Phase 2
weighs two ways of using what is elsewhere, and takes the cheaper:

    run there   the subtask goes to a ready container there: round trip + MigCost of what is not there
    bring here  state comes to a container here: MigCost, with a cold start unless a ready container merely lacks the
                newest state

`mig_cost_ms` is MigCost, the one place where moving state and files gets its price; `Link` has what was measured.

Phase 3 is a cold start. Every way is charged what it has to fetch, a cold start too: so gamma compares like with like.

Worked example, weights 0.5 / 0.3 / 0.2: a vision container (1 core, 256 MB) for a base skill that needs half a
core and 512 MB and no volume: 0.5 * 0.5 + 0.3 * min(1, 2, 0.5) + 0.2 * 1 = 0.25 + 0.15 + 0.2 = 0.6. With 40 MB of
state on gw-2, 50 MB/s to it and 5 ms/MB to pack and unpack, bringing it to a ready container here costs
40 / 50 s + 40 * 5 ms = 1000 ms, and some 45 ms for asking; a container that is ready on gw-2 costs the round trip, so
the subtask goes there.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence

from msgspec import Struct, field
from msgspec.structs import replace

from appliance.model import Choice, Considered, ContainerInfo, ContainerState, Need, Phase, VolumeInfo, Way
from appliance.pool.settings import PoolConfig, Weights

COMPATIBLE_SCORE = 0.5
"""s_img of an image that can run the skill but is another (paper)."""
MOST_CONSIDERED = 12
"""Possibilities that a record keeps of one decision."""
MB = 1e6

_NOT_READY = {
    ContainerState.STARTING: "still starting",
    ContainerState.RESERVED: "reserved for another run",
    ContainerState.BUSY: "busy",
    ContainerState.DRAINING: "draining",
    ContainerState.DEAD: "dead",
}


class Candidate(Struct, frozen=True, kw_only=True):
    """A container of another gateway and the round trip to there, milliseconds."""

    container: ContainerInfo
    round_trip_ms: float


GUESS_BYTES_PER_S = 12.5e6
"""A link that was not measured yet: 100 Mbit/s, the slowest wired one on a site."""
GUESS_HANDLING_BYTES_PER_S = 200e6
"""Packing or unpacking before it was measured: half of what one loaded core does."""
BRING_MS = 40.0
"""What bringing a volume costs however small it is: asking for it, the snapshot there, the swap here (measured with a
file of 14 bytes on a loaded machine: 50 to 80 ms to the first line of the handler)."""


class Link(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What is known of a gateway's link: moving averages, bytes per second; None: not measured yet."""

    bytes_per_s: float | None = None
    pack_bytes_per_s: float | None = None
    """Serialise, there."""
    unpack_bytes_per_s: float | None = None
    """Deserialise, here."""
    round_trip_ms: float = 5.0

    @property
    def bandwidth(self) -> float:
        """Bytes per second, a careful guess before it was measured."""
        return self.bytes_per_s or GUESS_BYTES_PER_S


UNMEASURED = Link()
Move = tuple[int, Link]
"""So many bytes over a link."""


def mig_cost_ms(state: Iterable[Move], *, files: Iterable[Move] = (), start_ms: float = 0.0) -> float:
    """MigCost (algorithms, Container selection): bytes / bandwidth + serialise + deserialise + start, milliseconds.

    Args:
        state: volumes that have to come; each is asked for, packed there and unpacked here.
        files: files that have to come, as they are.
        start_ms: the start of the container that they are for; 0 for one that is ready.
    """
    cost_ms = start_ms + sum(size / link.bandwidth * 1e3 for size, link in files)
    for size, link in state:
        pack = link.pack_bytes_per_s or GUESS_HANDLING_BYTES_PER_S
        unpack = link.unpack_bytes_per_s or GUESS_HANDLING_BYTES_PER_S
        cost_ms += BRING_MS + link.round_trip_ms + max(0, size) * (1 / link.bandwidth + 1 / pack + 1 / unpack) * 1e3
    return cost_ms


class Facts(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a selection must know besides containers. The defaults: no inputs, no state anywhere, unmeasured links."""

    inputs: Mapping[str, int] = field(default_factory=dict[str, int])
    """Gateway -> bytes of the subtask's input files that are there."""
    volumes: Mapping[str, tuple[VolumeInfo, ...]] = field(default_factory=dict[str, tuple[VolumeInfo, ...]])
    """Who holds the newest state of each volume asked for; a volume without state anywhere is left out."""
    links: Mapping[str, Link] = field(default_factory=dict[str, Link])
    """What was measured of the links to other gateways."""
    avoid: Mapping[str, str] = field(default_factory=dict[str, str])
    """Gateways whose containers are not to be used, with the reason."""

    def link(self, gateway: str) -> Link:
        """Return what is known of the link to a gateway."""
        return self.links.get(gateway, UNMEASURED)


class Decision(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where a subtask runs. `container` is None for a cold start; `why` explains it to people.

    `reservation` names the hold on a local container, so that a decision whose lease has run out is noticed. With
    way `bring here` the newest state must be fetched before the run starts, in whatever phase it is.
    """

    phase: Phase
    gateway: str
    container: str | None = None
    score: float = 0.0
    cost_ms: float = 0.0
    way: Way = Way.HERE
    why: str = ""
    reservation: str = ""
    choice: Choice | None = None
    """The same with all that was considered, for the task's record."""


def score(container: ContainerInfo, need: Need, weights: Weights) -> float | None:
    """Return Score(c, T) in [0, 1], or None when c is no candidate for T."""
    if container.image == need.image:
        image = 1.0
    elif need.image in container.compatible:
        image = COMPATIBLE_SCORE
    else:
        return None
    resources = min(container.cpu / need.cpu, container.memory_mb / need.memory_mb, 1.0)
    wanted = frozenset(need.volumes)
    volumes = len(wanted.intersection(container.volumes)) / len(wanted) if wanted else 1.0
    return weights.image * image + weights.resources * resources + weights.volumes * volumes


def best_local(containers: Iterable[ContainerInfo], need: Need, weights: Weights) -> tuple[ContainerInfo, float] | None:
    """Return the ready container with the best score, and that; the id settles ties, so that all decide alike."""
    found: tuple[ContainerInfo, float] | None = None
    for container in containers:
        if container.state is not ContainerState.READY:
            continue
        value = score(container, need, weights)
        if value is None:
            continue
        if found is None or (value, container.id) > (found[1], found[0].id):
            found = (container, value)
    return found


class Prices:
    """What each way of serving a need costs, milliseconds. `here` is the gateway that decides."""

    def __init__(self, need: Need, facts: Facts, config: PoolConfig, *, here: str, cold_ms: float) -> None:
        self._facts = facts
        known: Mapping[str, tuple[VolumeInfo, ...]] = facts.volumes if config.mode == "federated" else {}
        self._state = [known[name] for name in sorted(set(need.volumes)) if known.get(name)]
        missing = [each for each in self._state if not _is_at(each, here)]
        self.lacks_state = bool(missing)
        """Whether the newest state of a volume asked for is elsewhere only."""
        self.state_bytes = sum(each[0].size_bytes for each in missing)
        files = [(size, facts.link(at)) for at, size in facts.inputs.items() if at != here and size > 0]
        moves = [((holder.size_bytes, facts.link(holder.gateway)) for holder in each) for each in missing]
        state = [min(each, key=lambda move: mig_cost_ms((move,))) for each in moves]
        self.warm_ms = mig_cost_ms(state, files=files)
        """Using a ready container here."""
        self.cold_ms = mig_cost_ms(state, files=files, start_ms=cold_ms)
        """Starting one here."""

    def there(self, candidate: Candidate) -> float:
        """Running in a container elsewhere: round trip, and what is not there yet."""
        gateway = candidate.container.gateway
        # Our link to it stands for the one that state would really take: those between others are not measured here.
        link = self._facts.link(gateway)
        files = [(size, link) for at, size in self._facts.inputs.items() if at != gateway]
        missing = [(each[0].size_bytes, link) for each in self._state if not _is_at(each, gateway)]
        return candidate.round_trip_ms + mig_cost_ms(missing, files=files)


def _is_at(holders: Sequence[VolumeInfo], gateway: str) -> bool:
    return any(each.gateway == gateway for each in holders)


class _Weighed(Struct, frozen=True):
    """A candidate elsewhere with its worth; `problem` says why it cannot be taken."""

    candidate: Candidate
    score: float
    cost_ms: float
    problem: str

    @property
    def rank(self) -> tuple[float, float, str, str]:
        """The best score first, then the least cost; ids settle ties, so that all decide alike."""
        container = self.candidate.container
        return (self.score, -self.cost_ms, container.gateway, container.id)


def weigh(
    candidates: Iterable[Candidate], need: Need, *, prices: Prices, config: PoolConfig, avoid: Mapping[str, str]
) -> list[_Weighed]:
    """Return what others offer, the best first, each with why it cannot be taken: theta, gamma, its state."""
    found: list[_Weighed] = []
    limit_ms = config.gamma * prices.cold_ms
    for candidate in candidates:
        container = candidate.container
        value = score(container, need, config.weights)
        if value is None:
            continue
        cost_ms = prices.there(candidate)
        problem = ""
        if container.gateway in avoid:
            problem = avoid[container.gateway]
        elif container.state is not ContainerState.READY:
            problem = _NOT_READY[container.state]
        elif value < config.theta_match:
            problem = f"score {value:.2f} below {config.theta_match:.2f}"
        elif not cost_ms < limit_ms:
            problem = f"costs {cost_ms:.0f} ms, more than {config.gamma:g} of a cold start ({prices.cold_ms:.0f} ms)"
        found.append(_Weighed(candidate, value, cost_ms, problem))
    found.sort(key=lambda each: each.rank, reverse=True)
    return sorted(found, key=lambda each: bool(each.problem))


def select(
    need: Need,
    local: Sequence[ContainerInfo],
    remote: Sequence[Candidate],
    cold_ms: float,
    config: PoolConfig,
    *,
    gateway: str = "",
    facts: Facts | None = None,
) -> Decision:
    """Decide where a subtask runs.

    Args:
        need: T = (image, cpu, mem, volumes).
        local: this gateway's containers in any state (phase 1 takes the ready ones).
        remote: offers of others (phase 2).
        cold_ms: ColdCost(T), measured here.
        config: weights, theta_match, gamma, mode.
        gateway: this gateway's id.
        facts: inputs, state and links.

    Returns:
        Phase 1, 2 or 3 with the way, the container, its score and cost, why, and what else was considered.
    """
    facts = facts or Facts()
    prices = Prices(need, facts, config, here=gateway, cold_ms=cold_ms)
    here = best_local(local, need, config.weights) if config.mode != "cold" else None
    offers: list[_Weighed] = []
    if config.mode == "federated" and (here is None or prices.lacks_state):
        offers = weigh(remote, need, prices=prices, config=config, avoid=facts.avoid)
    there = offers[0] if offers and not offers[0].problem else None
    if there is not None and (here is None or there.cost_ms < prices.warm_ms):
        decision = _run_there(there, prices, here=here)
    elif here is not None:
        decision = _use_here(*here, prices, offers, gateway=gateway)
    else:
        decision = _start_here(need, prices, offers, gateway=gateway, mode=config.mode)
    considered = _considered(decision, need, local, offers, prices, config, gateway=gateway)
    choice = Choice(
        phase=decision.phase,
        way=decision.way,
        by=gateway,
        gateway=decision.gateway,
        container=decision.container or "",
        cold_ms=round(prices.cold_ms, 1),
        considered=considered,
        why=decision.why,
    )
    return replace(decision, choice=choice)


def _use_here(
    container: ContainerInfo, value: float, prices: Prices, offers: Sequence[_Weighed], *, gateway: str
) -> Decision:
    if prices.lacks_state:
        size = size_text(prices.state_bytes)
        than = f", cheaper than {offers[0].cost_ms:.0f} ms elsewhere" if offers and not offers[0].problem else ""
        way, why = Way.BRING_HERE, f"ready here without the newest state: {prices.warm_ms:.0f} ms for {size}{than}"
    else:
        way, why = Way.HERE, f"best of this gateway's ready containers, score {value:.2f}"
    return Decision(
        phase=Phase.LOCAL_WARM,
        gateway=gateway,
        container=container.id,
        score=value,
        cost_ms=prices.warm_ms,
        way=way,
        why=why,
    )


def _run_there(there: _Weighed, prices: Prices, *, here: tuple[ContainerInfo, float] | None) -> Decision:
    container = there.candidate.container
    if here is None:
        instead = f"none ready here, cold would be {prices.cold_ms:.0f} ms"
    else:
        size = size_text(prices.state_bytes)
        instead = f"its state is not here, bringing {size} would be {prices.warm_ms:.0f} ms"
    return Decision(
        phase=Phase.REMOTE_WARM,
        gateway=container.gateway,
        container=container.id,
        score=there.score,
        cost_ms=there.cost_ms,
        way=Way.RUN_THERE,
        why=f"{instead}; on {container.gateway} score {there.score:.2f} for {there.cost_ms:.1f} ms",
    )


def _start_here(need: Need, prices: Prices, offers: Sequence[_Weighed], *, gateway: str, mode: str) -> Decision:
    if mode == "cold":
        why = "mode is cold: always a new container"
    else:
        none = f", none of {len(offers)} elsewhere good enough" if offers else ""
        why = f"no {need.image} container ready here{none}: a new one, about {prices.cold_ms:.0f} ms"
        if prices.lacks_state:
            why += f" with {size_text(prices.state_bytes)} of state"
    return Decision(
        phase=Phase.COLD,
        gateway=gateway,
        cost_ms=prices.cold_ms,
        way=Way.BRING_HERE if prices.lacks_state else Way.NEW,
        why=why,
    )


def _considered(
    decision: Decision,
    need: Need,
    local: Sequence[ContainerInfo],
    offers: Sequence[_Weighed],
    prices: Prices,
    config: PoolConfig,
    *,
    gateway: str,
) -> tuple[Considered, ...]:
    """Return what was weighed: the one taken first, then what could have been, the best first; at most 12."""
    rows = [
        *_local_rows(decision, need, local, prices, config, gateway=gateway),
        *(_offer_row(decision, each) for each in offers),
    ]
    if decision.phase is not Phase.LOCAL_WARM:
        taken = decision.phase is Phase.COLD
        row = Considered(
            gateway=gateway,
            image=need.image,
            way=Way.BRING_HERE if prices.lacks_state else Way.NEW,
            cost_ms=round(prices.cold_ms, 1),
            taken=taken,
            verdict="taken" if taken else f"{prices.cold_ms:.0f} ms, dearer",
        )
        rows.append((True, row))
    rows.sort(key=lambda row: (not row[1].taken, not row[0], -row[1].score, row[1].cost_ms, row[1].gateway))
    return tuple(each for _, each in rows[:MOST_CONSIDERED])


def _local_rows(
    decision: Decision,
    need: Need,
    local: Sequence[ContainerInfo],
    prices: Prices,
    config: PoolConfig,
    *,
    gateway: str,
) -> Iterator[tuple[bool, Considered]]:
    """The containers here that could serve the need, each with whether it could be taken now."""
    way = Way.BRING_HERE if prices.lacks_state else Way.HERE
    price = f"{prices.warm_ms:.0f} ms for {size_text(prices.state_bytes)} of state" if prices.lacks_state else ""
    for container in local:
        value = score(container, need, config.weights)
        if value is None:
            continue
        taken = decision.phase is Phase.LOCAL_WARM and container.id == decision.container
        if taken:
            verdict = price or "taken"
        elif container.state is not ContainerState.READY:
            verdict = _NOT_READY[container.state]
        elif config.mode == "cold":
            verdict = "mode is cold"
        elif decision.phase is Phase.LOCAL_WARM:
            verdict = "as good as the one taken" if value >= decision.score else "another scores better"
        else:
            verdict = f"{price}, dearer"
        row = Considered(
            gateway=gateway,
            container=container.id,
            image=container.image,
            way=way,
            score=round(value, 3),
            cost_ms=round(prices.warm_ms, 1),
            taken=taken,
            verdict=verdict,
        )
        yield container.state is ContainerState.READY and config.mode != "cold", row


def _offer_row(decision: Decision, offer: _Weighed) -> tuple[bool, Considered]:
    container = offer.candidate.container
    where = (container.gateway, container.id)
    taken = decision.way is Way.RUN_THERE and where == (decision.gateway, decision.container)
    row = Considered(
        gateway=container.gateway,
        container=container.id,
        image=container.image,
        way=Way.RUN_THERE,
        score=round(offer.score, 3),
        cost_ms=round(offer.cost_ms, 1),
        taken=taken,
        verdict="taken" if taken else offer.problem or f"{offer.cost_ms:.1f} ms, another is better",
    )
    return not offer.problem, row


def size_text(size: int) -> str:
    """A number of bytes for people."""
    if size < 1000:
        return f"{size} B"
    return f"{size / 1e3:.0f} kB" if size < MB else f"{size / MB:.0f} MB"
