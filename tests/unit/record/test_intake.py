"""The bounded queue between the event loop and the writer thread."""

import threading

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.record.models import LoggedMessage
from appliance.record.recorder import Drop, Intake


def _message(size: int) -> LoggedMessage:
    return LoggedMessage("k", 5, b"x" * size)


@settings(deadline=None)
@given(sizes=st.lists(st.one_of(st.none(), st.integers(0, 40)), max_size=60))
def test_nothing_is_lost_silently(sizes: list[int | None]) -> None:
    """Whatever comes (None: the writer takes), each message is taken in order or counted, within both bounds."""
    intake = Intake(messages=5, payload_bytes=100)
    came = taken = dropped = 0
    for size in [*sizes, None]:
        if size is None:
            out, drops = intake.take(0)
            assert len(out) <= 5
            assert sum(len(message.payload) for message in out) <= 100
            taken += len(out)
            dropped += drops.get("queue full", Drop()).count
        else:
            came += 1
            intake.put(_message(size))
    assert came == taken + dropped
    assert len(intake) == 0


def test_losses_by_reason() -> None:
    """Losses elsewhere are handed over under their own reason, once."""
    intake = Intake(messages=5, payload_bytes=100)
    intake.lose("too large", Drop(2, 10, "a", 1))
    intake.lose("too large", Drop(1, 5, "b", 2))
    assert intake.take(0)[1] == {"too large": Drop(3, 15, "b", 2)}
    assert intake.take(0)[1] == {}


def test_a_burst_waits_for_room_and_a_stuck_writer_costs_messages() -> None:
    """A batch waits until the writer has taken what is there; when it does not, batches are dropped and counted."""
    intake = Intake(messages=5, payload_bytes=1000)
    intake.put_all([_message(1)] * 4)
    taker = threading.Timer(0.05, lambda: intake.take(0))
    taker.start()
    intake.put_all([_message(2)] * 4)
    taker.join()
    assert [len(each.payload) for each in intake.take(0)[0]] == [2] * 4
    for _ in range(20):  # with a wait each this would take ten seconds
        intake.put_all([_message(1)] * 4)
    out, drops = intake.take(0)
    assert len(out) == 5
    assert drops["queue full"].count == 75


def test_a_burst_of_pictures_waits_for_room_too() -> None:
    """What would not fit by its bytes waits for the writer as well as what would not by its number."""
    intake = Intake(messages=100, payload_bytes=100)
    intake.put_all([_message(30)] * 3)
    taker = threading.Timer(0.05, lambda: intake.take(0))
    taker.start()
    intake.put_all([_message(20)] * 4)
    taker.join()
    out, drops = intake.take(0)
    assert [len(each.payload) for each in out] == [20] * 4
    assert drops == {}


def _put(intake: Intake, key: str, count: int) -> int:
    """Put so many messages on a key; returns how many were taken."""
    return sum(intake.put(LoggedMessage(key, 5, b"x")) for _ in range(count))


def test_telemetry_is_thinned_before_anything_else_is_lost() -> None:
    """By the rule: all to three quarters, one in four of each key to seven eighths; orders and tasks to the end."""
    intake = Intake(messages=800, payload_bytes=10_000)
    frames, other = "swiftbot/f/robot/drone_1/mavlink/rx", "swiftbot/f/robot/drone_2/state"
    assert _put(intake, frames, 600) == 600
    assert _put(intake, frames, 100) == 25
    assert _put(intake, other, 100) == 25
    assert _put(intake, frames, 1000) == 50
    for key in ("task/t-1/transition", "operator/stop/o-1", "robot/drone_1/commanded", "gw/gw-1/log"):
        assert _put(intake, f"swiftbot/f/{key}", 25) == 25
    assert _put(intake, "swiftbot/f/task/t-1/transition", 1) == 0
    out, drops = intake.take(0)
    assert len(out) == 800
    assert drops["thinned"].count == 75 + 75 + 950
    assert drops["thinned"].keys == {"robot/*/mavlink/*": 1025, "robot/*/state": 75}
    assert drops["queue full"].keys == {"task/*/transition": 1}
    assert _put(intake, frames, 600) == 600


def test_a_batch_with_orders_in_it_keeps_them() -> None:
    """Of what comes together the telemetry is thinned, however little of it is something else."""
    intake = Intake(messages=80, payload_bytes=10_000)
    frames = [LoggedMessage("swiftbot/f/robot/drone_1/mavlink/rx", number, b"x") for number in range(500)]
    frames[400:400] = [LoggedMessage("swiftbot/f/operator/stop/o-1", 7, b"{}")]
    intake.put_all(frames)
    out, drops = intake.take(0)
    assert "swiftbot/f/operator/stop/o-1" in {each.key for each in out}
    assert drops["thinned"].count == 501 - len(out)
