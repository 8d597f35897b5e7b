"""Logs made of logs: recovered, merged, trimmed, printed."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from appliance.errors import ConfigError, RecordError
from appliance.record.edit import EDITED, Select, cat, copy, instant, text_line
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read

SECOND = 10**9


def write(path: Path, messages: list[tuple[int, str, bytes]], *, finish: bool = True) -> Path:
    """Write a log of (time, key, payload)."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=120)
        writer.start()
        schema = writer.register_schema("swiftbot.Thing", "jsonschema", b'{"type":"object"}')
        channels: dict[str, int] = {}
        for at, key, payload in messages:
            if key not in channels:
                channels[key] = writer.register_channel(key, "json", schema, {"encoding": "application/json"})
            writer.add_message(channels[key], at, payload, at)
        writer.add_metadata("swiftbot", {"fleet": "f1"})
        if finish:
            writer.finish()
    return path


times = st.lists(st.integers(1, 50), max_size=30)


@given(times, times, st.integers(0, 60), st.integers(0, 60))
def test_merged_by_time_and_nothing_lost(
    tmp_path_factory: pytest.TempPathFactory, one: list[int], two: list[int], since: int, until: int
) -> None:
    """A merge holds exactly the messages within the window, each file's in its own order, by the latest time so far."""
    folder = tmp_path_factory.mktemp("merge")
    paths = [
        write(folder / f"{name}.mcap", [(at, f"k/{name}", b'{"n":%d}' % place) for place, at in enumerate(some)])
        for name, some in (("one", one), ("two", two))
    ]
    select = Select(since_ns=since, until_ns=until)
    told = copy(paths, folder / "out.mcap", select)
    found = list(read(folder / "out.mcap"))
    for name, some in (("one", one), ("two", two)):
        expected = [(at, b'{"n":%d}' % place) for place, at in enumerate(some) if since <= at < until]
        assert [(each.at_ns, each.payload) for each in found if each.key == f"k/{name}"] == expected
    assert told.messages == len(found)
    if one == sorted(one) and two == sorted(two):
        assert [each.at_ns for each in found] == sorted(each.at_ns for each in found)


def test_trimmed_by_key(tmp_path: Path) -> None:
    """Keys that match are kept unless they are left out; the file says what it was made of and is a proper one."""
    log = write(tmp_path / "a.mcap", [(n, f"swiftbot/f/{'ab'[n % 2]}/{n % 3}", b"{}") for n in range(1, 13)])
    told = copy([log], tmp_path / "out.mcap", Select(keys=("swiftbot/*/a/**",), without=("**/0",)))
    assert {channel.key for channel in told.channels} == {"swiftbot/f/a/1", "swiftbot/f/a/2"}
    with (tmp_path / "out.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        made = {each.name: each.metadata for each in reader.iter_metadata()}
    assert made["swiftbot"] == {"fleet": "f1"}
    assert made[EDITED] == {"of": "a.mcap", "keys": "swiftbot/*/a/**", "without": "**/0"}


def test_an_interrupt_leaves_nothing(tmp_path: Path) -> None:
    """Whatever ends a copy early, neither the file nor a part of it is left."""
    log = write(tmp_path / "a.mcap", [(1, "k", b"{}")])

    def interrupt(count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        copy([log], tmp_path / "out.mcap", progress=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_source_that_is_no_log_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    """One bad name among several: an error that names it, and no file."""
    log = write(tmp_path / "a.mcap", [(1, "k", b"{}")])
    (tmp_path / "b.mcap").write_bytes(b"nonsense")
    with pytest.raises(RecordError, match=r"b\.mcap is not an MCAP file"):
        copy([log, tmp_path / "b.mcap"], tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_unfinished_files_are_merged_into_a_finished_one(tmp_path: Path) -> None:
    """What a killed recorder left is taken to its last whole chunk."""
    whole = write(tmp_path / "a.mcap", [(n, "k", b"{}") for n in range(1, 20)])
    cut = write(tmp_path / "b.mcap", [(n, "l", b"{}") for n in range(1, 40)], finish=False)
    expected = info(cut).messages
    assert 0 < expected < 40
    told = copy([whole, cut], tmp_path / "out.mcap")
    assert (told.messages, told.recovered) == (19 + expected, False)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("12.5", 112.5), ("12.5s", 112.5), ("+3", 103), ("-3", 197), ("0", 100),
        ("1970-01-01T00:02:00", 120), ("1970-01-01T01:02:00+01:00", 120),
    ],
)  # fmt: skip
def test_what_people_mean_by_a_time(text: str, expected: float) -> None:
    """Seconds count from the start, negative ones from the end, and ISO 8601 is UTC unless it says otherwise."""
    assert instant(text, start_ns=100 * SECOND, end_ns=200 * SECOND) == round(expected * SECOND)


def test_what_is_no_time() -> None:
    """Anything else is refused with the ways to write one."""
    with pytest.raises(ConfigError, match="is no time"):
        instant("yesterday", start_ns=0, end_ns=0)


def test_cat_prints_what_matches(tmp_path: Path) -> None:
    """Lines are filtered by key, time and text; JSON lines carry JSON payloads as JSON; the limit holds."""
    log = write(tmp_path / "a.mcap", [(n * SECOND, f"k/{n % 2}", b'{"n":%d}' % n) for n in range(1, 9)])
    lines: list[str] = []
    select = Select(keys=("k/1",), since_ns=2 * SECOND)
    assert cat([log], select, grep="n.:[357]", limit=2, as_json=True, write=lines.append) == []
    assert [json.loads(line)["value"] for line in lines] == [{"n": 3}, {"n": 5}]
    with pytest.raises(ConfigError, match="regular expression"):
        cat([log], select, grep="(", write=lines.append)


def test_a_log_cannot_steer_the_terminal() -> None:
    """Escape sequences and other control characters in payloads are shown, not sent; bytes are shown as such."""
    line = text_line(LoggedMessage("k", 1_500_000_000, b"\x1b[2Jgone\nnext", ""))
    assert line == "1970-01-01T00:00:01.500000Z k \\x1b[2Jgone\\nnext"
    assert text_line(LoggedMessage("k", 0, bytes(30) + b"\xff", "")).endswith("<31 bytes " + "00" * 20 + "…>")
    assert text_line(LoggedMessage("k", 0, "Dock 3 – süd".encode(), "")).endswith("k Dock 3 – süd")
