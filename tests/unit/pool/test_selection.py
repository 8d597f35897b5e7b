"""Container selection as Algorithm 1 has it."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import ContainerInfo, ContainerState, Need, Phase, VolumeInfo, Way
from appliance.pool.selection import (
    BRING_MS,
    MOST_CONSIDERED,
    UNMEASURED,
    Candidate,
    Facts,
    Link,
    mig_cost_ms,
    score,
    select,
    size_text,
)
from appliance.pool.settings import PoolConfig, Weights

IMAGES = ("base", "vision", "other")
VOLUMES = ("maps", "weights", "logs")

needs = st.builds(
    Need,
    image=st.sampled_from(IMAGES),
    cpu=st.floats(0.1, 8),
    memory_mb=st.integers(16, 4096),
    volumes=st.lists(st.sampled_from(VOLUMES), unique=True).map(tuple),
)


def containers(gateway: str = "g1") -> st.SearchStrategy[ContainerInfo]:
    """Containers of a gateway, in any state."""
    return st.builds(
        ContainerInfo,
        id=st.text("abcdef", min_size=4, max_size=6),
        gateway=st.just(gateway),
        image=st.sampled_from(IMAGES),
        state=st.sampled_from(ContainerState),
        cpu=st.floats(0.1, 8),
        memory_mb=st.integers(16, 4096),
        volumes=st.lists(st.sampled_from(VOLUMES), unique=True).map(tuple),
        compatible=st.lists(st.sampled_from(IMAGES), unique=True).map(tuple),
    )


def some(gateway: str = "g1") -> st.SearchStrategy[list[ContainerInfo]]:
    """A few containers, each with an id of its own."""
    return st.lists(containers(gateway), max_size=6, unique_by=lambda each: each.id)


candidates = st.builds(
    Candidate,
    container=st.sampled_from(("g2", "g3")).flatmap(containers),
    round_trip_ms=st.floats(0, 1000),
)
offered = st.lists(candidates, max_size=6, unique_by=lambda each: (each.container.gateway, each.container.id))


@st.composite
def some_facts(draw: st.DrawFn) -> Facts:
    """Inputs and state on any gateway, behind links of any speed."""
    link = Link(bytes_per_s=draw(st.floats(1e6, 1e10)), round_trip_ms=draw(st.floats(0, 100)))
    volumes = draw(
        st.dictionaries(
            st.sampled_from(VOLUMES),
            st.tuples(st.lists(st.sampled_from(("g1", "g2", "g3")), min_size=1, unique=True), st.integers(0, 10**9)),
        )
    )
    return Facts(
        inputs=draw(st.dictionaries(st.sampled_from(("g1", "g2", "g3")), st.integers(0, 10**8))),
        volumes={
            name: tuple(VolumeInfo(name=name, gateway=each, generation=1, size_bytes=size) for each in gateways)
            for name, (gateways, size) in volumes.items()
        },
        links=dict.fromkeys(("g1", "g2", "g3"), link),
        avoid=draw(st.dictionaries(st.just("g3"), st.just("it lies"), max_size=1)),
    )


MAPS = VolumeInfo(name="maps", gateway="g2", generation=3, size_bytes=40_000_000)
LINK = Link(bytes_per_s=50e6, pack_bytes_per_s=400e6, unpack_bytes_per_s=400e6, round_trip_ms=2.0)
SLOW = Facts(volumes={"maps": (MAPS,)}, links={"g1": LINK, "g2": LINK})
"""40 MB of state on g2, 50 MB/s away: 800 ms, 200 ms to pack and unpack, and 42 ms however small it were."""
WITH_MAPS = Need(image="base", volumes=("maps",))


def ready(name: str, gateway: str = "g1", **fields: object) -> ContainerInfo:
    """Return a ready base container."""
    return ContainerInfo(id=name, gateway=gateway, image="base", state=ContainerState.READY, **fields)  # type: ignore[arg-type]


def there(name: str, round_trip_ms: float = 2.0, gateway: str = "g2", **fields: object) -> Candidate:
    """Return an offer of another gateway."""
    return Candidate(container=ready(name, gateway, **fields), round_trip_ms=round_trip_ms)


@given(containers(), needs)
def test_score_is_between_0_and_1(container: ContainerInfo, need: Need) -> None:
    """A score is in [0, 1], and there is one exactly where the image is right or compatible."""
    value = score(container, need, Weights())
    assert (value is not None) == (need.image in (container.image, *container.compatible))
    assert value is None or 0 <= value <= 1 + 1e-9


@given(containers(), needs)
def test_more_is_never_worse(container: ContainerInfo, need: Need) -> None:
    """A container with more memory and all volumes scores at least as well."""
    before = score(container, need, Weights())
    richer = ContainerInfo(
        id="x", gateway="g1", image=container.image, state=container.state, cpu=container.cpu * 2,
        memory_mb=container.memory_mb * 2, volumes=VOLUMES, compatible=container.compatible,
    )  # fmt: skip
    after = score(richer, need, Weights())
    assert (before is None) == (after is None)
    assert before is None or after is None or after >= before


def test_worked_examples() -> None:
    """The example of the module's docstring, and a perfect match."""
    need = Need(image="base", cpu=0.5, memory_mb=512)
    vision = ContainerInfo(
        id="v", gateway="g1", image="vision", state=ContainerState.READY, cpu=1, memory_mb=256, compatible=("base",)
    )
    assert score(vision, need, Weights()) == pytest.approx(0.6)
    base = ContainerInfo(id="b", gateway="g1", image="base", state=ContainerState.READY, cpu=1, memory_mb=512)
    assert score(base, need, Weights()) == pytest.approx(1.0)


@given(needs, some(), offered, st.floats(1, 2000))
def test_phases_in_order(need: Need, local: list[ContainerInfo], remote: list[Candidate], cold_ms: float) -> None:
    """Without state: local if any local container will do, else remote within theta and gamma, else cold."""
    config = PoolConfig()
    decision = select(need, local, remote, cold_ms, config, gateway="g1")
    fit = [
        (value, c.id)
        for c in local
        if c.state is ContainerState.READY and (value := score(c, need, config.weights)) is not None
    ]
    far = [
        (value, c)
        for c in remote
        if c.container.state is ContainerState.READY
        and (value := score(c.container, need, config.weights)) is not None
        and value >= 0.6
        and c.round_trip_ms < 0.5 * cold_ms
    ]
    if fit:
        assert (decision.phase, decision.way) == (Phase.LOCAL_WARM, Way.HERE)
        assert (decision.score, decision.container) == max(fit)
    elif far:
        assert (decision.phase, decision.way) == (Phase.REMOTE_WARM, Way.RUN_THERE)
        assert decision.score == max(value for value, _ in far)
        assert decision.cost_ms == min(c.round_trip_ms for value, c in far if value == decision.score)
    else:
        assert (decision.phase, decision.container, decision.gateway) == (Phase.COLD, None, "g1")
        assert decision.way is Way.NEW
    assert decision.why


@given(needs, some(), offered, st.floats(1, 5000), some_facts())
def test_state_that_exists_is_never_left_behind(
    need: Need, local: list[ContainerInfo], remote: list[Candidate], cold_ms: float, facts: Facts
) -> None:
    """Where the newest state of a volume is elsewhere, the subtask goes there or the state comes."""
    decision = select(need, local, remote, cold_ms, PoolConfig(), gateway="g1", facts=facts)
    held = [[each.gateway for each in facts.volumes[name]] for name in need.volumes if name in facts.volumes]
    elsewhere = any("g1" not in holders for holders in held)
    assert (decision.way in (Way.BRING_HERE, Way.RUN_THERE)) or not elsewhere
    assert decision.way is not Way.BRING_HERE or elsewhere
    assert (decision.gateway == "g1") == (decision.way is not Way.RUN_THERE)


@given(needs, some(), offered, st.floats(1, 5000), some_facts())
def test_the_cheaper_way_is_taken_and_every_decision_is_explained(
    need: Need, local: list[ContainerInfo], remote: list[Candidate], cold_ms: float, facts: Facts
) -> None:
    """What is taken stands first, the rest with a reason; running there is never dearer than what was possible here."""
    decision = select(need, local, remote, cold_ms, PoolConfig(), gateway="g1", facts=facts)
    choice = decision.choice
    assert choice is not None
    assert (choice.phase, choice.way, choice.by) == (decision.phase, decision.way, "g1")
    assert 1 <= len(choice.considered) <= MOST_CONSIDERED
    first = choice.considered[0]
    assert first.taken
    assert not any(each.taken for each in choice.considered[1:])
    assert (first.gateway, first.container, first.way) == (decision.gateway, decision.container or "", decision.way)
    assert all(each.verdict for each in choice.considered)
    assert decision.gateway not in facts.avoid
    if decision.way is Way.RUN_THERE:
        assert decision.cost_ms < 0.5 * choice.cold_ms + 1
        dearer = [each.cost_ms for each in choice.considered if each.verdict.endswith("dearer")]
        assert all(cost + 1 > decision.cost_ms for cost in dearer)


def test_the_subtask_goes_to_its_state_when_that_is_cheaper() -> None:
    """40 MB of state on g2: a container that is ready there for 2 ms beats bringing it here for 1042 ms."""
    offers = [there("far", volumes=("maps",))]
    decision = select(WITH_MAPS, [ready("near")], offers, 500, PoolConfig(), gateway="g1", facts=SLOW)
    assert (decision.phase, decision.way, decision.gateway) == (Phase.REMOTE_WARM, Way.RUN_THERE, "g2")
    assert decision.choice is not None
    refused = next(each for each in decision.choice.considered if each.container == "near")
    assert refused.way is Way.BRING_HERE
    assert refused.cost_ms == pytest.approx(1042)
    assert refused.verdict == "1042 ms for 40 MB of state, dearer"


def test_the_state_comes_here_when_that_is_cheaper() -> None:
    """A little state on g2 and large inputs here: a ready container here gets the state, at no cost of a start."""
    facts = Facts(
        volumes={"maps": (VolumeInfo(name="maps", gateway="g2", generation=1, size_bytes=1_000_000),)},
        inputs={"g1": 10_000_000},
        links=SLOW.links,
    )
    offers = [there("far", volumes=("maps",))]
    decision = select(WITH_MAPS, [ready("near")], offers, 500, PoolConfig(), gateway="g1", facts=facts)
    assert (decision.phase, decision.way, decision.container) == (Phase.LOCAL_WARM, Way.BRING_HERE, "near")
    assert decision.cost_ms == pytest.approx(25 + BRING_MS + 2)


def test_without_a_container_anywhere_the_state_comes_to_a_new_one() -> None:
    """Bring here with a cold start costs both, and says so."""
    decision = select(WITH_MAPS, [], [], 500, PoolConfig(), gateway="g1", facts=SLOW)
    assert (decision.phase, decision.way, decision.container) == (Phase.COLD, Way.BRING_HERE, None)
    assert decision.cost_ms == pytest.approx(1542)
    assert "40 MB of state" in decision.why


def test_state_that_is_here_needs_nobody_else() -> None:
    """Phase 1 serves when the newest state is on this gateway, or nowhere."""
    mine = VolumeInfo(name="maps", gateway="g1", generation=3, size_bytes=40_000_000)
    for facts in (Facts(volumes={"maps": (mine,)}), Facts(volumes={"maps": (MAPS, mine)}), Facts()):
        decision = select(
            WITH_MAPS, [ready("near", volumes=("maps",))], [there("far")], 500, PoolConfig(), gateway="g1", facts=facts
        )
        assert (decision.way, decision.container) == (Way.HERE, "near")


def test_input_bytes_keep_a_subtask_near_them() -> None:
    """100 MB of input here cost 2 s to g2: more than half a cold start, and the record says so."""
    facts = Facts(inputs={"g1": 100_000_000}, links=SLOW.links)
    decision = select(Need(image="base"), [], [there("far")], 500, PoolConfig(), gateway="g1", facts=facts)
    assert decision.phase is Phase.COLD
    assert decision.choice is not None
    far = next(each for each in decision.choice.considered if each.gateway == "g2")
    assert far.verdict == "costs 2002 ms, more than 0.5 of a cold start (500 ms)"
    there_too = Facts(inputs={"g2": 100_000_000}, links=SLOW.links)
    decision = select(Need(image="base"), [], [there("far")], 500, PoolConfig(), gateway="g1", facts=there_too)
    assert decision.gateway == "g2"


def test_verdicts_name_what_stood_in_the_way() -> None:
    """Busy, too poor, to be avoided: each candidate with its own reason."""
    need = Need(image="base", cpu=2.0, memory_mb=512)
    busy = ContainerInfo(id="b", gateway="g1", image="base", state=ContainerState.BUSY)
    compatible = ContainerInfo(
        id="v", gateway="g2", image="vision", state=ContainerState.READY, cpu=0.2, compatible=("base",)
    )
    decision = select(
        need, [busy], [Candidate(container=compatible, round_trip_ms=1), there("far", gateway="g3", cpu=2.0)], 500,
        PoolConfig(), gateway="g1", facts=Facts(avoid={"g3": "had none when asked"}),
    )  # fmt: skip
    assert decision.choice is not None
    verdicts = {each.container: each.verdict for each in decision.choice.considered}
    assert verdicts == {"": "taken", "b": "busy", "v": "score 0.48 below 0.60", "far": "had none when asked"}


@given(
    size=st.integers(0, 10**12),
    link=st.builds(Link, bytes_per_s=st.none() | st.floats(1, 1e12), pack_bytes_per_s=st.none() | st.floats(1, 1e12)),
)
def test_migration_cost_is_finite_and_grows_with_size(size: int, link: Link) -> None:
    """MigCost is never negative or infinite and grows with the bytes, whatever was measured."""
    assert 0 <= mig_cost_ms([(size, link)]) < math.inf
    assert mig_cost_ms([(size, link)]) <= mig_cost_ms([(size + 1, link)])


def test_migration_cost_by_hand() -> None:
    """Each part of the formula: state, files, start; and a link that was not measured."""
    link = Link(bytes_per_s=100e6, pack_bytes_per_s=500e6, unpack_bytes_per_s=250e6, round_trip_ms=3.0)
    # 100 MB over 100 MB/s, packed at 500 and unpacked at 250 MB/s.
    assert mig_cost_ms([(100_000_000, link)]) == pytest.approx(1000 + 200 + 400 + BRING_MS + 3)
    assert mig_cost_ms((), files=[(50_000_000, link)], start_ms=400) == pytest.approx(500 + 400)
    # 12.5 MB at a guess of 12.5 MB/s, and 200 MB/s to pack and to unpack.
    assert mig_cost_ms([(12_500_000, UNMEASURED)]) == pytest.approx(BRING_MS + 5 + 1000 + 2 * 62.5)
    assert mig_cost_ms(()) == 0
    assert mig_cost_ms([(-(10**9), link)]) == BRING_MS + 3, "a size that cannot be makes no gateway attractive"


def test_sizes_are_told_in_round_figures() -> None:
    """Bytes, kilobytes, megabytes."""
    assert [size_text(each) for each in (0, 999, 1500, 40_000_000)] == ["0 B", "999 B", "2 kB", "40 MB"]


@given(needs, offered, st.randoms())
def test_order_does_not_matter(need: Need, remote: list[Candidate], random: object) -> None:
    """All who see the same offers choose the same."""
    shuffled = list(remote)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    first, second = (select(need, [], offers, 500, PoolConfig()) for offers in (remote, shuffled))
    assert (first.gateway, first.container) == (second.gateway, second.container)


@given(needs, some(), offered)
def test_modes(need: Need, local: list[ContainerInfo], remote: list[Candidate]) -> None:
    """`cold` takes nothing warm, `local` nothing remote."""
    assert select(need, local, remote, 500, PoolConfig(mode="cold")).phase is Phase.COLD
    alone = select(need, local, remote, 500, PoolConfig(mode="local"), gateway="g1", facts=SLOW)
    assert alone.way in (Way.HERE, Way.NEW)
