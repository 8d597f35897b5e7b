"""The ledger of command ids."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Failure, RobotCommand, RobotReply
from appliance.robots import executor as module
from appliance.robots.executor import IdempotencyLog, Verdict

pytestmark = pytest.mark.anyio


def order(identity: str, attempt: int = 1, task: str = "t", subtask: str = "s1") -> RobotCommand:
    """Make a command."""
    return RobotCommand(id=identity, verb="goto", task=task, subtask=subtask, attempt=attempt)


async def test_a_finished_id_is_answered_with_its_reply() -> None:
    """The same id again gets the stored reply, whatever its attempt."""
    book = IdempotencyLog("r")
    command, reply = order("t/s1/1"), RobotReply(id="t/s1/1", result={"x": 1})
    assert book.decide(command) == (Verdict.NEW, None)
    await book.take(command)
    await book.finish(command, reply)
    assert book.decide(command) == (Verdict.ANSWER, reply)
    assert book.decide(order("t/s1/1", attempt=2)) == (Verdict.ANSWER, reply)


async def test_a_failed_id_is_done_anew_by_a_higher_attempt_alone() -> None:
    """A failure is final for its attempt, and the reason for the next one."""
    book = IdempotencyLog("r")
    reply = RobotReply(id="t/s1/1", failure=Failure(code="robot", message="no"))
    await book.finish(order("t/s1/1"), reply)
    assert book.decide(order("t/s1/1")) == (Verdict.ANSWER, reply)
    assert book.decide(order("t/s1/1", attempt=2)) == (Verdict.NEW, None)


async def test_lower_attempts_are_fenced_per_subtask() -> None:
    """A lower attempt of the same task and subtask is refused, that of another subtask is not."""
    book = IdempotencyLog("r")
    book.see(order("t/s1/1", attempt=3))
    assert book.decide(order("t/s1/2", attempt=2))[0] is Verdict.STALE
    assert book.decide(order("t/s2/1", attempt=1, subtask="s2"))[0] is Verdict.NEW
    assert book.decide(RobotCommand(id="by-hand", verb="hold"))[0] is Verdict.NEW


async def test_it_survives_a_restart(store: module.KeyValues) -> None:
    """A new process knows outcomes, attempts and what was interrupted."""
    before = IdempotencyLog("r", store)
    done, open_ = order("t/s1/1", attempt=2), order("t/s2/1", subtask="s2")
    await before.take(done)
    await before.finish(done, RobotReply(id=done.id, result={"x": 1}))
    await before.take(open_)
    after = IdempotencyLog("r", store)
    await after.load()
    assert after.decide(done) == (Verdict.ANSWER, RobotReply(id=done.id, result={"x": 1}))
    assert after.decide(open_) == (Verdict.INTERRUPTED, None)
    assert after.decide(order("t/s1/9", attempt=1))[0] is Verdict.STALE


async def test_unreadable_entries_are_dropped(store: module.KeyValues) -> None:
    """A damaged entry costs itself, not the ledger."""
    await IdempotencyLog("r", store).take(order("t/s1/1"))
    await store.put("robots/ledger/r/bad", b"{")
    book = IdempotencyLog("r", store)
    await book.load()
    assert len(book) == 1
    assert [key for key, _ in await store.scan("robots/ledger/r/")] == ["robots/ledger/r/t/s1/1"]


async def test_it_is_bounded_in_entries_and_bytes(store: module.KeyValues, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest go first, in memory and in the store, by number and by the size of blobs."""
    book = IdempotencyLog("r", store, limit=3)
    for number in range(6):
        await book.take(order(f"t/s1/{number}"))
    assert len(book) == 3
    assert len(await store.scan("robots/ledger/r/")) == 3
    assert book.decide(order("t/s1/0"))[0] is Verdict.NEW
    monkeypatch.setattr(module, "MAX_BLOB_BYTES", 100)
    for number in range(3):
        command = order(f"p/{number}")
        await book.finish(command, RobotReply(id=command.id, blobs={"image.png": b"x" * 60}))
    assert book.decide(order("p/1"))[0] is Verdict.NEW
    assert book.decide(order("p/2"))[0] is Verdict.ANSWER


@given(attempts=st.lists(st.integers(1, 5), min_size=1, max_size=20))
def test_no_attempt_below_the_highest_passes(attempts: list[int]) -> None:
    """Whatever the order of attempts, only those as high as the highest seen get through."""
    book = IdempotencyLog("r")
    highest = 0
    for number, attempt in enumerate(attempts):
        verdict, _ = book.decide(order(f"t/s1/{number}", attempt=attempt))
        assert (verdict is Verdict.STALE) == (attempt < highest)
        if verdict is Verdict.NEW:
            book.see(order(f"t/s1/{number}", attempt=attempt))
            highest = max(highest, attempt)
