"""Concurrent versions of a task after a partition: every gateway picks the same one."""

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.plane.dht import Record
from appliance.pool.lineage import VolumeRecord
from appliance.tasks.resolve import resolver, stronger


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
