"""Zenoh alone, as the DHT benchmark asks it: answers that come too late, or twice."""

import asyncio
from collections.abc import Callable
from typing import Any, cast

import pytest

from workshop.bench.dht import bare

pytestmark = pytest.mark.anyio


class FakeSession:
    """Answers at once, so many times, and whenever the test says so."""

    def __init__(self, answers: int) -> None:
        self.answers = answers
        self.answer: Callable[[Any], object] = print

    def get(self, key: str, handler: Callable[[Any], object], **_options: object) -> None:
        """Ask."""
        self.answer = handler
        for _ in range(self.answers):
            handler(key)


@pytest.mark.parametrize("answers", [2, 0])
async def test_an_answer_that_nobody_waits_for_breaks_nothing(answers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second answer, and one after the question was given up, leave no error on the event loop."""
    broken: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: broken.append(context))
    session = FakeSession(answers)
    if answers:
        await bare._ask(cast("Any", session), "k", b"x")
    else:
        monkeypatch.setattr(bare, "ANSWER_S", 0.0)
        with pytest.raises(TimeoutError):
            await bare._ask(cast("Any", session), "k", b"x")
    session.answer("late")
    for _ in range(3):
        await asyncio.sleep(0)
    assert broken == []
