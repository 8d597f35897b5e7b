"""What the terminal UI remembers: bounded, the latest of everything, and what has changed."""

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import GatewayStatus, RecorderNote, RunEvent, RunEventKind, TaskRecord, TaskState
from appliance.model.recorder_api import RecorderStatus
from appliance.tui.store import Connection, Shelf, Store


def test_store_keeps_the_later_record() -> None:
    """An older record that comes late does not replace a newer one."""
    store = Store(tasks=10, entries=10)
    new = TaskRecord(id="t", instruction="x", sequence=5, state=TaskState.RUNNING)
    store.take_task(new)
    assert not store.take_task(TaskRecord(id="t", instruction="x", sequence=4))
    assert dict(store.tasks) == {"t": new}


@settings(deadline=None)
@given(numbers=st.lists(st.integers(0, 60), max_size=80))
def test_store_is_bounded(numbers: list[int]) -> None:
    """However many tasks and lines come, only the newest are kept, newest task first."""
    store = Store(tasks=5, entries=7)
    for number in numbers:
        store.take_task(TaskRecord(id=f"t{number}", instruction="x", created_ns=number))
        store.take_run(RunEvent(task="t", subtask="s", attempt=1, kind=RunEventKind.LOG, note=str(number)), 1)
    assert [store.tasks[name].created_ns for name in store.newest] == sorted(set(numbers), reverse=True)[:5]
    assert len(store.entries) == min(7, len(numbers))
    assert [entry.serial for entry in store.entries] == list(range(1, len(numbers) + 1))[-7:]


def test_lines_are_one_line_each() -> None:
    """A log text with line breaks is one line, and a very long one is cut."""
    store = Store(tasks=1, entries=5)
    store.add(1, kind="log", level="info", source="x", text="a\nb" + "c" * 9000)
    assert store.entries[0].text.startswith("a b")
    assert len(store.entries[0].text) == 500


def test_recorder_falls_silent() -> None:
    """A recorder not heard for a while is silent, one that stopped is forgotten, and only so many are believed."""
    store = Store(tasks=1, entries=1)
    for number in range(50):
        store.take_recorder(RecorderStatus(id=f"r{number}", fleet="f", state="recording"), now=100.0)
    assert len(store.recorders) == 20
    store.take_recorder(RecorderStatus(id="r1", fleet="f", state="recording"), now=104.0)
    store.take_recorder(RecorderStatus(id="r2", fleet="f", state="stopped"), now=104.0)
    store.listen_for_silence(106.0)
    states = {status.id: status.state for status in store.recorders.values()}
    assert states["r0"] == "silent"
    assert states["r1"] == "recording"
    assert "r2" not in states


def test_recorder_that_gateways_know_to_be_gone() -> None:
    """It is silent as soon as all gateways say so, unless it was heard a moment ago."""
    store = Store(tasks=1, entries=1)
    for name, heard_at in (("r0", 100.0), ("r1", 101.5)):
        store.take_recorder(RecorderStatus(id=name, fleet="f", state="recording"), now=heard_at)
    notes = (RecorderNote(id="r0", state="silent"), RecorderNote(id="r1", state="silent"))
    store.take_gateways({"gw-1": GatewayStatus(id="gw-1", fleet="f", recorders=notes)}, now_ns=1)
    store.listen_for_silence(102.0)
    assert {status.id: status.state for status in store.recorders.values()} == {"r0": "silent", "r1": "recording"}


@settings(deadline=None)
@given(
    steps=st.lists(st.tuples(st.sampled_from("abcdef"), st.one_of(st.none(), st.integers(0, 3)))),
    looks=st.sets(st.integers(0, 40)),
)
def test_who_follows_the_changes_knows_all(steps: list[tuple[str, int | None]], looks: set[int]) -> None:
    """Somebody who takes only what has changed since the last look has exactly what is on the shelf."""
    shelf: Shelf[int] = Shelf(4)
    known: dict[str, int] = {}
    seen = 0
    for number, (key, value) in enumerate(steps):
        if value is None:
            shelf.drop(key)
        else:
            shelf.put(key, value)
        assert len(shelf) <= 4
        if number in looks:
            changes = shelf.since(seen)
            if changes.whole:
                known.clear()
            known.update({each: shelf[each] for each in changes.changed})
            for each in changes.gone:
                known.pop(each, None)
            seen = changes.revision
            assert known == dict(shelf)


def test_unchanged_values_are_no_news() -> None:
    """Putting what is there already changes no revision, so that nothing is drawn for it."""
    shelf: Shelf[int] = Shelf(2)
    assert shelf.put("a", 1)
    revision = shelf.revision
    assert not shelf.put("a", 1)
    assert shelf.revision == revision
    assert shelf.put("b", 1)
    assert not shelf.put("c", 1)
    assert shelf.refused == 1


def test_lost_gateway_is_kept_with_since_when() -> None:
    """A gateway that went away is kept with the time of it, is back when it is back, and is forgotten after a while."""
    store = Store()
    status = GatewayStatus(id="gw-a", fleet="f")
    store.take_gateways({"gw-a": status}, 1_000)
    store.measured("gw-a", latency_ms=1.26, arc=0.5)
    assert store.gateways["gw-a"].latency_ms == 1.3
    store.take_gateways({}, 2_000)
    store.take_gateways({}, 3_000)
    assert store.gateways["gw-a"].lost_ns == 2_000
    assert store.gateways["gw-a"].latency_ms is None
    store.take_gateways({"gw-a": status}, 4_000)
    assert store.gateways["gw-a"].lost_ns == 0
    store.take_gateways({}, 5_000)
    store.take_gateways({}, 5_000 + 2 * 3600 * 10**9)
    assert not store.gateways


def test_a_problem_keeps_its_beginning() -> None:
    """As long as the same is wrong with the connection, it is shown since when; the same news is no change."""
    store = Store()
    store.tell(Connection(problem="gone", remedy="wait", since_ns=5))
    revision = store.revision("connection")
    store.tell(Connection(problem="gone", remedy="wait"))
    assert store.connection.since_ns == 5
    assert store.revision("connection") == revision
    store.tell(Connection(connected=True))
    assert store.connection.connected
    assert store.revision("connection") > revision
