"""How plans are laid out."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Subtask
from appliance.tui import plan_editor


@st.composite
def graphs(draw: st.DrawFn) -> tuple[Subtask, ...]:
    """Make graphs of any kind: with cycles, unknown predecessors and repeated ids."""
    names = st.sampled_from([f"s{number}" for number in range(6)])
    return tuple(
        Subtask(id=draw(names), skill="x", after=tuple(draw(st.lists(names | st.just("gone"), max_size=3))))
        for _ in range(draw(st.integers(0, 8)))
    )


@given(subtasks=graphs())
def test_every_graph_is_laid_out(subtasks: tuple[Subtask, ...]) -> None:
    """Each id stands once and has a depth, whatever the graph; without a cycle below and deeper than what is before."""
    order, depth = plan_editor.ordered(subtasks), plan_editor.depths(subtasks)
    assert sorted(order) == sorted(depth) == sorted({each.id for each in subtasks})
    if plan_editor.cycle(subtasks):
        return
    first = {each.id: each for each in reversed(subtasks)}
    for each in first.values():
        for other in each.after:
            if other in first and other != each.id:
                assert order.index(other) < order.index(each.id)
                assert depth[other] < depth[each.id]


def test_long_chain_needs_no_recursion() -> None:
    """A chain longer than Python's stack is laid out as well."""
    chain = [Subtask(id=f"s{each}", skill="x", after=(f"s{each - 1}",) if each else ()) for each in range(3000)]
    assert plan_editor.ordered(chain)[-1] == "s2999"
    assert len(plan_editor.branch(2999)) < 40
