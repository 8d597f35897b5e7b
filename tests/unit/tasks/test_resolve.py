"""Concurrent versions of a task after a partition: every gateway picks the same one."""

import random

import msgspec
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import Attempt, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState, encode
from appliance.plane.dht import Record
from appliance.pool.volumes.lineage import VolumeRecord
from appliance.tasks.conflicts import MOST_SPLITS, merged, resolver, stronger


def record(state: TaskState, done: int, sequence: int, coordinator: str) -> bytes:
    """Encode a version of a task."""
    subtasks = tuple(
        SubtaskRecord(
            subtask=Subtask(id=f"s{number}", skill="goto"),
            state=SubtaskState.SUCCEEDED if number < done else SubtaskState.RUNNING,
        )
        for number in range(3)
    )
    return msgspec.json.encode(
        TaskRecord(id="t", instruction="x", state=state, subtasks=subtasks, sequence=sequence, coordinator=coordinator)
    )


VERSIONS = st.one_of(
    st.builds(
        record,
        st.sampled_from(TaskState),
        st.integers(0, 3),
        st.integers(1, 9),
        st.sampled_from(["gw-1", "gw-2", "gw-10", ""]),
    ),
    st.binary(max_size=8),
)


@given(VERSIONS, VERSIONS, VERSIONS)
def test_the_choice_does_not_depend_on_who_asks_or_in_which_order(one: bytes, two: bytes, three: bytes) -> None:
    """Commutative, associative, and one of the two: a total order."""
    assert stronger(one, two) == stronger(two, one)
    assert stronger(stronger(one, two), three) == stronger(one, stronger(two, three))
    assert stronger(one, two) in (one, two)


def test_a_final_state_stands_then_progress_then_the_lower_gateway() -> None:
    """The order of the design: terminal state, further progress, lower id."""
    ended = record(TaskState.CANCELLED, 0, 3, "gw-2")
    far = record(TaskState.RUNNING, 2, 9, "gw-2")
    near = record(TaskState.RUNNING, 1, 9, "gw-1")
    assert stronger(ended, far) == ended
    assert stronger(far, near) == far
    low = record(TaskState.RUNNING, 1, 9, "gw-1")
    assert stronger(low, record(TaskState.RUNNING, 1, 9, "gw-2")) == low


def test_what_cannot_be_read_never_stands_against_what_can() -> None:
    """A damaged record loses to any readable one."""
    good = record(TaskState.ACCEPTED, 0, 1, "gw-9")
    assert stronger(b"\xff\xff", good) == good


def test_volumes_are_resolved_by_their_lineage() -> None:
    """Of two records of a volume the one with more runs behind it stands, whichever bytes are the larger."""
    more, fewer = (
        Record(key="volume/v", value=msgspec.json.encode(VolumeRecord(name="v", version=version, gateway="a")))
        for version in ({"a": 3}, {"a": 1, "z": 1})
    )
    assert resolver("volume/v", more, fewer) == resolver("volume/v", fewer, more) == more


def running(coordinator: str, *, progress: float = 0.0, load: float = 0.0, free: int = 0, sequence: int = 5) -> bytes:
    """Encode a version of a task whose only subtask runs on a gateway with these figures."""
    subtask = SubtaskRecord(
        subtask=Subtask(id="s1", skill="count"),
        state=SubtaskState.RUNNING,
        gateway=coordinator,
        progress=progress,
        attempts=(Attempt(number=1, gateway=coordinator, load=load, free=free),),
    )
    return encode(
        TaskRecord(
            id="t", instruction="x", state=TaskState.RUNNING, subtasks=(subtask,), coordinator=coordinator,
            sequence=sequence,
        )
    )  # fmt: skip


def test_progress_then_load_then_ready_containers_then_the_lower_gateway_decide() -> None:
    """As far as the records themselves have the figures, so that all gateways compute alike; transitions come last."""
    far = running("gw-9", progress=0.6, load=0.9)
    idle, busy = running("gw-9", progress=0.5, load=0.1), running("gw-1", progress=0.5, load=0.2, free=9)
    assert merged_winner(far, idle) == far
    assert merged_winner(idle, busy) == idle
    many, few = running("gw-9", load=0.1, free=3), running("gw-1", load=0.1, free=2)
    assert merged_winner(many, few) == many
    low, high = running("gw-1"), running("gw-2", sequence=50)
    assert merged_winner(low, high) == low


def merged_winner(one: bytes, other: bytes) -> bytes:
    """Which of the two stands."""
    return stronger(one, other)


def test_the_version_that_stands_remembers_the_one_that_lost() -> None:
    """Whose it was, and which attempts it had made where; what a newer appliance wrote beside that is kept."""
    fields = msgspec.json.decode(running("gw-1", progress=0.9)) | {"novelty": [1, 2]}
    value = merged(running("gw-2"), msgspec.json.encode(fields))
    record = msgspec.json.decode(value, type=TaskRecord)
    (split,) = record.splits
    assert (split.coordinator, split.settled) == ("gw-2", False)
    assert [(each.subtask, each.attempt, each.gateway) for each in split.runs] == [("s1", 1, "gw-2")]
    assert msgspec.json.decode(value)["novelty"] == [1, 2]
    one, other = (
        Record(key="task/t", value=each, version={"a": 1}, write="w")
        for each in (running("gw-1", progress=0.9), running("gw-2"))
    )
    assert resolver("task/t", one, other).write == "", "its writer would take it for its own"


def test_what_was_settled_stays_settled() -> None:
    """A copy that knows a lost version as unsettled does not bring it back."""
    first = msgspec.json.decode(merged(running("gw-1", progress=0.9), running("gw-2")), type=TaskRecord)
    settled = replace(first, splits=tuple(replace(each, settled=True) for each in first.splits))
    met = msgspec.json.decode(merged(encode(settled), encode(first)), type=TaskRecord)
    assert met.splits == settled.splits


PARTS = st.one_of(
    st.builds(
        running,
        st.sampled_from(["gw-1", "gw-2", "gw-3", "gw-4"]),
        progress=st.sampled_from([0.0, 0.5]),
        load=st.sampled_from([0.0, 0.5]),
        free=st.integers(0, 2),
        sequence=st.integers(1, 12),
    ),
    VERSIONS,
)


@settings(deadline=None)
@given(st.lists(PARTS, min_size=3, max_size=12), st.randoms(use_true_random=False))
def test_parts_that_meet_in_any_order_come_to_the_same_record(parts: list[bytes], rng: random.Random) -> None:
    """Commutative and associative, and bounded, however often copies meet again."""
    one, two, three = parts[:3]
    assert merged(one, two) == merged(two, one)
    assert merged(merged(one, two), three) == merged(one, merged(two, three))
    ends = set()
    for _ in range(3):
        rng.shuffle(parts)
        copies = [*parts, *parts[:2]]
        while len(copies) > 1:
            rng.shuffle(copies)
            copies.append(merged(copies.pop(), copies.pop()))
        ends.add(copies[0])
    assert len(ends) == 1
    try:
        record = msgspec.json.decode(ends.pop(), type=TaskRecord)
    except msgspec.DecodeError:
        return
    assert len(record.splits) <= MOST_SPLITS
