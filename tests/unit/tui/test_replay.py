"""Recorded logs in place of a fleet: what was heard then is on the screens, at any moment, in whatever order."""

import asyncio
import time
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import NotFoundError, RecordError, RefusedError
from appliance.model import TaskRecord
from appliance.record.reader import read
from appliance.tui.app import SwiftbotApp
from appliance.tui.replay import Cursor, ReplayView, skipped, streamed
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Store
from appliance.tui.subscriptions import Hearing

pytestmark = pytest.mark.anyio

LOG = Path(__file__).parents[2] / "replay" / "logs" / "demo.mcap"
"""A real log of a local fleet."""


def filled(messages: object, fleet: str) -> Store:
    """Return a store that has heard messages."""
    store = Store()
    hearing = Hearing(store, fleet)
    for each in messages:  # pyright: ignore[reportGeneralTypeIssues]
        hearing.hear(each.key, each.payload, each.at_ns, deleted=each.deleted)
    return store


def facts(store: Store) -> dict[str, object]:
    """Return what a store knows, without what depends on when it was heard."""
    return {
        "tasks": dict(store.tasks),
        "robots": dict(store.robots),
        "containers": dict(store.containers),
        "gateways": {name: each.status for name, each in store.gateways.items()},
    }


@settings(max_examples=12, deadline=None)
@given(share=st.floats(0, 1))
def test_seeking_gives_what_playing_gives(share: float) -> None:
    """At any moment the state that is sought is the one that hearing everything up to there gives."""
    sought = Cursor(LOG, skip=skipped, stream=streamed)
    at_ns = sought.about.start_ns + round(share * (sought.about.end_ns - sought.about.start_ns))
    played = Cursor(LOG, skip=skipped, stream=streamed)
    heard = []
    while True:
        part = played.on_to(at_ns, most=97)
        heard += part.messages
        if part.ended or part.reached_ns >= at_ns:
            break
    fresh = sought.to(at_ns)
    assert fresh.fresh
    assert facts(filled(fresh.messages, "demo")) == facts(filled(heard, "demo"))
    # It goes on from there, as if it had been played.
    assert sought.on_to(at_ns + 10**9, most=50).messages == played.on_to(at_ns + 10**9, most=50).messages


def test_bad_files_are_told(tmp_path: Path) -> None:
    """What is no log, or is not there, is refused; one that was cut off is played as far as it goes."""
    with pytest.raises(NotFoundError):
        Cursor(tmp_path / "none.mcap", skip=skipped, stream=streamed)
    (tmp_path / "text.mcap").write_text("no log")
    with pytest.raises(RecordError):
        Cursor(tmp_path / "text.mcap", skip=skipped, stream=streamed)
    data = LOG.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    cut = Cursor(tmp_path / "cut.mcap", skip=skipped, stream=streamed)
    assert 0 < cut.about.messages < Cursor(LOG, skip=skipped, stream=streamed).about.messages
    assert cut.to(cut.about.end_ns).messages


def last_records() -> dict[str, TaskRecord]:
    """Return each task as the log has it last."""
    found: dict[str, TaskRecord] = {}
    for message in read(LOG):
        if message.key.endswith("/record") and "/task/" in message.key and not message.deleted:
            record = msgspec.json.decode(message.payload, type=TaskRecord)
            found[record.id] = record
    return found


async def until(app: SwiftbotApp, pilot: object, check: object) -> None:
    """Wait until something holds."""
    until_s = time.monotonic() + 60
    while time.monotonic() < until_s:
        await asyncio.sleep(0.02)
        app.draw()
        if check():  # pyright: ignore[reportCallIssue]
            return
    pytest.fail("it does not come about")


async def test_screens_are_driven_by_the_log(tmp_path: Path) -> None:
    """Play, pause, seek and rate move all screens through the log; nothing can be ordered."""
    replay = await ReplayView.open(LOG)
    wanted = last_records()
    assert wanted
    app = SwiftbotApp(replay, TuiConfig(write=True, logs=(str(tmp_path),)))
    async with app.run_test(size=(100, 30)) as pilot:
        assert app.current_mode == "replay"
        assert not app.unlocked
        await pilot.press("colon", *"seek 100%", "enter")
        await until(app, pilot, lambda: dict(replay.store.tasks) == wanted)
        await pilot.press("2")
        await pilot.pause()
        with pytest.raises(RefusedError, match="recorded"):
            _ = replay.orders
        await pilot.press("W", "s")
        await pilot.pause()
        assert not app.unlocked
        assert not app.screen.is_modal
        await pilot.press("8", "colon", *"seek 0", "enter")
        await until(app, pilot, lambda: len(replay.store.tasks) < len(wanted))
        # So slow that the log's 11 s do not end before the next key is read, however busy the machine is.
        await pilot.press("colon", *"rate 0.25", "enter", "space")
        await until(app, pilot, lambda: replay.head.position_s(time.monotonic()) > 0.05)
        assert replay.head.rate == 0.25
        await pilot.press("space")
        await pilot.pause()
        assert replay.head.paused
        at_s = replay.head.position_s(time.monotonic())
        await pilot.press("left")
        assert replay.head.position_s(time.monotonic()) <= at_s
        await until(app, pilot, lambda: not replay.problem)


async def test_keys_of_the_log_can_be_listened_to() -> None:
    """The log screen shows any key of a replayed log as it is played."""
    replay = await ReplayView.open(LOG)
    heard: list[str] = []
    closer = replay.tap("swiftbot/*/task/*/record", lambda key, _at, _payload, _deleted: heard.append(key))
    await replay.start()
    replay.head.seek(replay.about.end_ns, time.monotonic())
    async with asyncio.timeout(30):
        while not heard:
            await asyncio.sleep(0.05)
    closer.close()
    await replay.close()
    assert all(key.endswith("/record") for key in heard)
