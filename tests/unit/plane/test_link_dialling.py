"""Which of two gateways dials the other."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.plane.link import dialled, rank, session_id

names = st.from_regex(r"[a-z][a-z0-9-]{0,15}", fullmatch=True)


def _as_zenoh_compares(session: str) -> bytes:
    return bytes.fromhex(session)[::-1]


@given(st.sets(names, min_size=2, max_size=12))
def test_of_each_two_one_dials_the_other(gateways: set[str]) -> None:
    """With the same table in each, every pair has one side that dials, nobody itself."""
    table = {name: f"tcp/{name}:7447" for name in gateways}
    pairs = [frozenset((name, endpoint[4:-5])) for name in gateways for endpoint in dialled(name, table)]
    assert len(pairs) == len(set(pairs)) == len(gateways) * (len(gateways) - 1) // 2
    assert all(len(pair) == 2 for pair in pairs)


@given(names, names, st.booleans())
def test_gossip_goes_by_the_same_order(one: str, other: str, names_both: bool) -> None:
    """Who dials by the table has the greater session id, at each start; one that only names others is above all."""
    table = {one: "tcp/a:1", other: "tcp/b:1"}
    if rank(one) != rank(other):
        first, second = session_id(one, naming=False), session_id(other, naming=False)
        dials = "tcp/b:1" in dialled(one, table)
        assert (_as_zenoh_compares(first) > _as_zenoh_compares(second)) is dials
    newcomer = session_id(one, naming=True)
    assert _as_zenoh_compares(newcomer) > _as_zenoh_compares(session_id(other if names_both else "", naming=False))


@pytest.mark.parametrize("naming", [True, False])
def test_a_session_id_is_one_for_zenoh_and_new_each_time(naming: bool) -> None:
    """32 hexadecimal digits, of which the first is no zero; two sessions of a gateway differ."""
    ids = {session_id("gw-1", naming=naming) for _ in range(500)}
    assert len(ids) == 500
    assert all(len(each) == 32 and each[0] != "0" for each in ids)
    assert len({each[-8:] for each in ids}) == 1, "the rank is kept over restarts"


def test_a_gateway_by_itself_dials_nobody() -> None:
    """Without a table, or alone in it."""
    assert dialled("gw-1", {}) == ()
    assert dialled("gw-1", {"gw-1": "tcp/a:1"}) == ()
