"""Keys of a run's records, and which version stands after a partition: the same in whatever order they meet."""

from typing import TypeVar

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import PayloadError
from appliance.learn import records
from appliance.model import encode, keyspace
from appliance.model.learning import (
    ClientState,
    Closed,
    Counted,
    Model,
    PartialUpdate,
    Recipe,
    RoundRecord,
    RunRecord,
    RunState,
    UpdateRecord,
)
from appliance.plane.records import Record


def test_keys_and_names_are_taken_apart_as_they_were_made() -> None:
    """Run, round and client; and the name under which a round's runs are published."""
    assert records.taken_apart(records.update_key("clips-1", 3, "rover_1")) == ("clips-1", 3, "rover_1")
    assert records.taken_apart(records.round_key("clips-1", 3)) == ("clips-1", 3, "")
    assert records.taken_apart(records.run_key("clips-1")) == ("clips-1", None, "")
    assert records.round_of(records.task_of("clips.x", 12)) == ("clips.x", 12)
    assert records.round_of("t-0123456789") is None
    kind = keyspace.record_kind(records.update_key("clips-1", 3, "rover_1"))
    assert kind is keyspace.LEARN_RECORD


@pytest.mark.parametrize("key", ["task/x", "learn/a/b", "learn/a/1/b/c"])
def test_other_keys_are_none_of_a_run(key: str) -> None:
    """They are refused, not guessed at."""
    with pytest.raises(PayloadError):
        records.taken_apart(key)


@pytest.mark.parametrize("value", [b"", b"[]", b"\xff", b"{}", b"[" * 5000])
def test_what_is_no_record_is_refused(value: bytes) -> None:
    """Bytes from elsewhere break nothing."""
    with pytest.raises(PayloadError):
        records.read(value, RunRecord)


T = TypeVar("T", bound=Struct)

runs = st.builds(
    RunRecord,
    id=st.just("r"),
    recipe=st.just(Recipe(model="clips")),
    state=st.sampled_from([RunState.RUNNING, RunState.PAUSED, RunState.STOPPED]),
    model=st.builds(Model, number=st.integers(0, 3), digest=st.sampled_from(["a", "b"])),
    clients=st.just(()),
    round=st.integers(1, 9),
    apart=st.sets(st.integers(1, 9), max_size=2).map(lambda found: tuple(sorted(found))),
    history=st.lists(
        st.builds(
            Closed, number=st.integers(1, 3), took_s=st.just(1.0), samples=st.integers(0, 3),
            digest=st.sampled_from(["", "x", "y"]),
        ),
        max_size=2,
        unique_by=lambda line: line.number,
    ).map(tuple),
)  # fmt: skip
rounds_ = st.builds(
    RoundRecord,
    run=st.just("r"),
    number=st.just(1),
    target=st.integers(0, 3),
    closed=st.booleans(),
    model=st.sampled_from(["", "x", "y"]),
    counted=st.lists(st.builds(Counted, client=st.just("a"), samples=st.integers(1, 3)), max_size=2).map(tuple),
)
parts_ = st.builds(
    PartialUpdate, client=st.just("a"), round=st.integers(1, 2), part=st.integers(0, 2), attempt=st.integers(1, 3)
)


@st.composite
def updates(draw: st.DrawFn) -> UpdateRecord:
    """Parts of one round, each once."""
    drawn = draw(st.lists(parts_, min_size=1, max_size=3, unique_by=lambda part: part.part))
    number = draw(st.integers(1, 2))
    parts = sorted((replace(part, round=number) for part in drawn), key=lambda part: part.part)
    return UpdateRecord(client="a", parts=tuple(parts))


@pytest.mark.parametrize("key", ["learn/r", "learn/r/1", "learn/r/1/a"])
@given(data=st.data())
def test_versions_that_meet_come_out_the_same_in_any_order(key: str, data: st.DataObject) -> None:
    """Commutative, and one that has been resolved stands against either of its parts."""
    kind = {"learn/r": runs, "learn/r/1": rounds_, "learn/r/1/a": updates()}[key]
    one, other = (Record(key=key, value=encode(data.draw(kind)), version={}, write="w") for _ in range(2))
    stands = records.resolve(key, one, other)
    assert records.resolve(key, other, one).value == stands.value
    assert records.resolve(key, stands, one).value == stands.value
    assert records.resolve(key, stands, other).value == stands.value


def counted(*clients: str, staleness: int = 0) -> tuple[Counted, ...]:
    """What counted in a round."""
    return tuple(Counted(client=client, samples=9, staleness=staleness) for client in clients)


def resolved(key: str, one: Struct, other: Struct, kind: type[T]) -> T:
    """What two versions come to."""
    first, second = (Record(key=key, value=encode(each), version={}, write="w") for each in (one, other))
    return records.read(records.resolve(key, first, second).value, kind)


def test_what_the_other_side_of_a_partition_has_done_is_found() -> None:
    """Apart in rounds 3 and 4 one side counted a, b and then a; the other c and d, and a's update of round 3 again."""
    common = Closed(number=2, took_s=1.0, samples=9, digest="m2")
    ours = RunRecord(
        id="r", recipe=Recipe(model="clips"), round=5, model=Model(number=4, digest="m4"),
        history=(common, Closed(number=3, took_s=1.0, digest="m3"), Closed(number=4, took_s=1.0, digest="m4")),
    )  # fmt: skip
    theirs = replace(
        ours, round=4, model=Model(number=3, digest="n3"), history=(common, Closed(number=3, took_s=1.0, digest="n3"))
    )
    run = resolved("learn/r", ours, theirs, RunRecord)
    assert (run.model.digest, run.apart) == ("m4", (3,))
    mine = RoundRecord(run="r", number=3, closed=True, model="m3", counted=counted("a", "b"))
    other = replace(mine, model="n3", counted=counted("a", "c", "d"))
    third = resolved("learn/r/3", mine, other, RoundRecord)
    assert third.model == "n3"  # more samples; what the standing run's side has counted is beside it
    fourth = RoundRecord(run="r", number=4, closed=True, model="m4", counted=counted("d", staleness=1))
    updates = [UpdateRecord(client=client, parts=(PartialUpdate(client=client, round=3),)) for client in "abcd"]
    found = records.unclaimed(run, {3: third, 4: fourth}, updates)
    assert [update.client for update in found] == ["c"]
    assert records.unclaimed(replace(run, round=9), {3: third, 4: fourth}, updates) == []


def test_more_rounds_stand_and_operators_words_of_either_side_hold() -> None:
    """The side that has closed more rounds wins; a client excluded, or a pause, on the other is kept."""
    client = ClientState(name="a")
    ahead = RunRecord(id="r", recipe=Recipe(model="clips"), model=Model(number=2), clients=(client,))
    behind = replace(
        ahead, model=Model(number=1), state=RunState.PAUSED, clients=(replace(client, excluded="by anna"),)
    )
    one, other = (Record(key="learn/r", value=encode(each), version={}, write="w") for each in (ahead, behind))
    stands = records.read(records.resolve("learn/r", one, other).value, RunRecord)
    assert stands.model.number == 2
    assert stands.state is RunState.PAUSED
    assert stands.clients[0].excluded == "by anna"
