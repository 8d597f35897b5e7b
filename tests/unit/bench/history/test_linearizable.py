"""The checker decides linearizability as brute force does on tiny histories, and on known good and bad ones."""

import itertools
import random
from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.bench.history.linearizable import Op, Value, check, step


def brute(history: Sequence[Op], initial: Value = None) -> bool:
    """Try every order of every choice of the operations whose outcome is unknown."""
    known = [op for op in history if op.returned_ns is not None]
    unknown = [op for op in history if op.returned_ns is None]
    for count in range(len(unknown) + 1):
        for chosen in itertools.combinations(unknown, count):
            if any(fits(order, initial) for order in itertools.permutations([*known, *chosen])):
                return True
    return False


def fits(order: Sequence[Op], initial: Value) -> bool:
    """Whether an order keeps real time and is what a register does."""
    for number, op in enumerate(order):
        if any(later.returned_ns is not None and later.returned_ns < op.called_ns for later in order[number:]):
            return False
    value = initial
    for op in order:
        good, value = step(op, value)
        if not good:
            return False
    return True


VALUES = st.sampled_from([None, 1, 2])


@st.composite
def operations(draw: st.DrawFn) -> Op:
    """Any operation, most of them short."""
    called = draw(st.integers(0, 12))
    returned = draw(st.one_of(st.none(), st.integers(called, called + 5), st.integers(called, called + 5)))
    kind = draw(st.sampled_from(["read", "write", "cas"]))
    if kind == "read" and returned is None:
        returned = called
    return Op(
        process="p", kind=kind, called_ns=called, returned_ns=returned, value=draw(VALUES), old=draw(VALUES),
        ok=kind != "cas" or returned is None or draw(st.booleans()),
    )  # fmt: skip


@settings(deadline=None)
@given(history=st.lists(operations(), max_size=6))
def test_it_decides_as_brute_force_does(history: list[Op]) -> None:
    """On every tiny history the answer is that of trying everything, and a linearization given is one."""
    verdict = check(history)
    assert verdict.linearizable is brute(history)
    if verdict.linearizable:
        assert fits([history[number] for number in verdict.order], None)


@settings(deadline=None)
@given(seed=st.integers(0, 10_000), processes=st.integers(1, 6), count=st.integers(1, 120))
def test_histories_of_a_real_register_are_linearizable(seed: int, processes: int, count: int) -> None:
    """Concurrent operations that take effect at one moment between call and return are always accepted."""
    assert check(register(seed, processes, count)).linearizable is True


@settings(deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_stale_read_is_found(seed: int) -> None:
    """A read of a value that was overwritten before it was called is refused, wherever in a long history it is."""
    history = register(seed, 4, 60)
    end = max(op.returned_ns or op.called_ns for op in history)
    bad = [
        Op(process="w", kind="write", called_ns=end + 1, returned_ns=end + 2, value="new"),
        Op(process="r", kind="read", called_ns=end + 3, returned_ns=end + 4, value="never written"),
    ]
    verdict = check([*history, *bad])
    assert verdict.linearizable is False
    assert len(history) + 1 in verdict.stuck


def register(seed: int, processes: int, count: int) -> list[Op]:
    """Simulate clients of a true register; some never hear of their outcome."""
    generator = random.Random(seed)  # noqa: S311 - a simulation
    value: Value = None
    free = dict.fromkeys(range(processes), 0)
    history: list[Op] = []
    for number in range(count):
        # Moments are drawn in rising order, calls and returns around them.
        moment = (number + 1) * 10
        process = generator.choice([each for each in free if free[each] < moment] or [number + 100])
        called = generator.randint(max(free.get(process, 0), moment - 35), moment)
        returned = moment + generator.randint(0, 35)
        kind = generator.choice(["read", "write", "cas"])
        lost = kind != "read" and generator.random() < 0.1
        free[process] = returned + 1
        old = generator.choice([value, "other"])
        ok = kind != "cas" or old == value
        op = Op(
            process=str(process), kind=kind, called_ns=called, returned_ns=None if lost else returned,
            value=value if kind == "read" else number, old=old, ok=ok or lost,
        )  # fmt: skip
        history.append(op)
        if kind == "write" or (kind == "cas" and ok):
            value = number
    return history


def op(kind: str, called: int, returned: int | None, value: Value, *, old: Value = None, ok: bool = True) -> Op:
    """Write a history shortly."""
    return Op(process="p", kind=kind, called_ns=called, returned_ns=returned, value=value, old=old, ok=ok)  # type: ignore[arg-type]


def test_known_bad_histories() -> None:
    """Lost update, read going back in time, two winners of one compare-and-set, a failed write that was seen."""
    bad = {
        "lost update": [op("write", 0, 1, 1), op("write", 2, 3, 2), op("read", 4, 5, 1)],
        "back in time": [op("write", 0, 9, 1), op("read", 1, 2, 1), op("read", 3, 4, None)],
        "two winners": [op("write", 0, 1, 1), op("cas", 2, 5, 2, old=1), op("cas", 3, 6, 3, old=1)],
        "refused in vain": [op("write", 0, 1, 1), op("cas", 2, 3, 2, old=1, ok=False)],
        "never written": [op("read", 0, 1, 7)],
    }
    for name, history in bad.items():
        assert check(history).linearizable is False, name


def test_what_is_unknown_may_have_happened_or_not() -> None:
    """A write without an answer explains a later read of it, of its absence, and even takes effect in between."""
    lost = op("write", 0, None, 1)
    assert check([lost, op("read", 5, 6, 1)]).linearizable
    assert check([lost, op("read", 5, 6, None)]).linearizable
    assert check([lost, op("read", 5, 6, None), op("read", 7, 8, 1)]).linearizable
    assert not check([lost, op("read", 5, 6, 1), op("read", 7, 8, None)]).linearizable


def test_a_long_search_is_given_up() -> None:
    """Beyond the bound the answer is that there is none."""
    assert check(register(1, 6, 100), most=5).linearizable is None
