"""Container selection as Algorithm 1 has it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import ContainerInfo, ContainerState, Need, Phase
from appliance.pool.selection import Candidate, best_remote, score, select
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


candidates = st.builds(Candidate, container=containers("g2"), cost_ms=st.floats(0, 1000))


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


@given(needs, st.lists(containers(), max_size=6), st.lists(candidates, max_size=6), st.floats(1, 2000))
def test_phases_in_order(need: Need, local: list[ContainerInfo], remote: list[Candidate], cold_ms: float) -> None:
    """Local if any local container will do, else remote within theta and gamma, else cold."""
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
        and c.cost_ms < 0.5 * cold_ms
    ]
    if fit:
        assert decision.phase is Phase.LOCAL_WARM
        assert (decision.score, decision.container) == max(fit)
    elif far:
        assert (decision.phase, decision.gateway) == (Phase.REMOTE_WARM, "g2")
        assert decision.score == max(value for value, _ in far)
        assert decision.cost_ms == min(c.cost_ms for value, c in far if value == decision.score)
    else:
        assert (decision.phase, decision.container, decision.gateway) == (Phase.COLD, None, "g1")
    assert decision.why


@given(needs, st.lists(candidates, max_size=6), st.randoms())
def test_order_does_not_matter(need: Need, remote: list[Candidate], random: object) -> None:
    """All who see the same offers choose the same."""
    shuffled = list(remote)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    first = best_remote(remote, need, cold_ms=500, config=PoolConfig())
    second = best_remote(shuffled, need, cold_ms=500, config=PoolConfig())
    assert (first is None) == (second is None)
    assert first is None or second is None or first[0].container.id == second[0].container.id


@given(needs, st.lists(containers(), max_size=4), st.lists(candidates, max_size=4))
def test_modes(need: Need, local: list[ContainerInfo], remote: list[Candidate]) -> None:
    """`cold` takes nothing warm, `local` nothing remote."""
    assert select(need, local, remote, 500, PoolConfig(mode="cold")).phase is Phase.COLD
    assert select(need, local, remote, 500, PoolConfig(mode="local")).phase is not Phase.REMOTE_WARM
