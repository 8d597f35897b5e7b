"""`swiftbot log …` from the command line, on a recorded run: each subcommand with its options, and what they refuse."""

import io
import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from appliance import cli
from appliance.ports import free_port
from appliance.record.reader import info, read

CUT_AWAY = 80_000
"""Bytes: the summary, and some chunks, the first of them not whole."""


@pytest.fixture(scope="module")
def log(project_root: Path) -> Path:
    """Return the log of a normal run."""
    return project_root / "tests" / "replay" / "logs" / "runs" / "normal.mcap"


@pytest.fixture
def swiftbot(capsys: pytest.CaptureFixture[str]) -> Any:
    """Return what runs a command in this process: its exit code and what it printed."""

    def run(*arguments: object) -> tuple[int, str]:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main([str(each) for each in arguments])
        assert isinstance(ended.value.code, int)
        shown = capsys.readouterr()
        assert "Traceback" not in shown.err
        return ended.value.code, shown.out if ended.value.code == 0 else shown.out + shown.err

    return run


def test_what_is_in_a_log(log: Path, swiftbot: Any) -> None:
    """`info` by its index and by reading every message say the same."""
    code, out = swiftbot("log", "info", log, "--json")
    found = json.loads(out)
    assert (code, found["messages"]) == (0, info(log).messages)
    code, out = swiftbot("log", "info", log, "--verify", "--json")
    assert (code, json.loads(out)["messages"]) == (0, found["messages"])


def test_cat(log: Path, swiftbot: Any) -> None:
    """Lines by key, not by another, by text and by time; as JSON, and no more than are wanted."""
    wanted = [each for each in read(log) if each.key.endswith("/transition")]
    assert len(wanted) > 10
    code, out = swiftbot("log", "cat", log, "--key", "**/transition", "--json")
    lines = [json.loads(line) for line in out.splitlines()]
    assert (code, [line["key"] for line in lines]) == (0, [each.key for each in wanted])
    assert lines[0]["value"] == msgspec.json.decode(wanted[0].payload)
    _, out = swiftbot("log", "cat", log, "--key", "**/transition", "--grep", '"planned"', "--limit", "2")
    assert len(out.splitlines()) == 2
    _, out = swiftbot("log", "cat", log, "--without", "**", "--limit", "5")
    assert out == ""
    _, out = swiftbot("log", "cat", log, "--from", "1", "--until", "2.5", "--json")
    times = [json.loads(line)["at_ns"] - info(log).start_ns for line in out.splitlines()]
    assert times
    assert all(10**9 <= each < 2.5 * 10**9 for each in times)


def test_trim_and_merge(log: Path, tmp_path: Path, swiftbot: Any) -> None:
    """Two parts of a log make the whole again; a name that is taken is refused."""
    for name, window in (("a", ("--until", "3")), ("b", ("--from", "3"))):
        assert swiftbot("log", "trim", log, "--out", tmp_path / f"{name}.mcap", *window)[0] == 0
    code, _ = swiftbot("log", "merge", tmp_path / "b.mcap", tmp_path / "a.mcap", "-o", tmp_path / "whole.mcap")
    assert code == 0
    whole, first = list(read(tmp_path / "whole.mcap")), list(read(tmp_path / "a.mcap"))
    assert sorted((each.at_ns, each.key) for each in whole) == sorted((each.at_ns, each.key) for each in read(log))
    assert 0 < len(first) < len(whole)
    code, out = swiftbot("log", "merge", log, "--out", tmp_path / "whole.mcap")
    assert code != 0
    assert "exists already" in " ".join(out.split())
    assert swiftbot("log", "merge", "--out", tmp_path / "none.mcap")[0] == 2


def test_recover(log: Path, tmp_path: Path, swiftbot: Any) -> None:
    """An unfinished file becomes a proper one beside it; the original stays as it is."""
    data = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[:-CUT_AWAY])
    assert json.loads(swiftbot("log", "info", cut, "--json")[1])["recovered"]
    code, out = swiftbot("log", "recover", cut, "--json")
    assert code == 0
    assert cut.read_bytes() == data[:-CUT_AWAY]
    made = info(tmp_path / "cut.recovered.mcap")
    assert not made.recovered
    assert 0 < made.messages == json.loads(out)["messages"] < info(log).messages


def test_pin(log: Path, tmp_path: Path, swiftbot: Any) -> None:
    """A pin lies beside its log, and can be taken back; what is no file has none."""
    copy = tmp_path / "incident.mcap"
    copy.write_bytes(log.read_bytes())
    assert swiftbot("log", "pin", copy)[0] == 0
    assert (tmp_path / "incident.mcap.pin").exists()
    assert swiftbot("log", "pin", copy, "--remove")[0] == 0
    assert not (tmp_path / "incident.mcap.pin").exists()
    assert swiftbot("log", "pin", tmp_path / "none.mcap")[0] == 4


def test_check(log: Path, tmp_path: Path, swiftbot: Any) -> None:
    """A log of this code's decisions ends with 0; one whose record was changed with 1 and both sides of it."""
    code, out = swiftbot("log", "check", log)
    assert code == 0
    assert "no decision comes out differently" in " ".join(out.split())
    out_file, changed = io.BytesIO(), 0
    writer = Writer(out_file)
    writer.start()
    with log.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            data = message.data
            if channel.topic.endswith("/record") and b'"state":"running"' in data and not changed:
                data, changed = data.replace(b'"state":"running"', b'"state":"failed"', 1), changed + 1
            number = writer.register_channel(channel.topic, channel.message_encoding, 0, dict(channel.metadata))
            writer.add_message(number, message.log_time, data, message.publish_time)
    writer.finish()
    assert changed
    other = tmp_path / "other.mcap"
    other.write_bytes(out_file.getvalue())
    code, out = swiftbot("log", "check", other)
    assert code == 1
    assert "come out differently; the first" in " ".join(out.split())
    assert "logged" in out
    assert "now" in out


def test_replay(log: Path, swiftbot: Any) -> None:
    """At full speed, a part by time and key, on other keys, without the clock; several logs are played together."""
    address = f"tcp/127.0.0.1:{free_port()}"
    usual = ("--listen", address, "--rate", "0", "--json")
    code, out = swiftbot("log", "replay", log, *usual)
    played = json.loads(out)
    assert (code, played["ended"], played["rounds"]) == (0, True, 1)
    assert played["messages"] + played["left_out"] == info(log).messages - _derived(log)
    part = ("--from", "1", "--until", "-1", "--key", "**/transition", "--without", "**/none", "--no-clock")
    code, out = swiftbot("log", "replay", log, log, *usual, *part, "--remap", "swiftbot/x=swiftbot/y", "--as", "then")
    assert code == 0
    assert 0 < json.loads(out)["messages"] < 2 * played["messages"]
    assert json.loads(out)["messages"] % 2 == 0


def _derived(log: Path) -> int:
    return info(log).messages - sum(1 for _ in read(log))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--rate", "-1"), "0 (as fast as possible) to 1000"),
        (("--remap", "nothing"), "is no rule"),
        (("--from", "yesterday"), "is no time"),
        (("--paused",), "needs a terminal"),
        (("--key", "*task"), "is no key expression"),
        (("--without", "**log"), "is no key expression"),
    ],
)
def test_replays_that_cannot_be(log: Path, swiftbot: Any, options: tuple[str, ...], told: str) -> None:
    """Each wrong option ends with 2 and says what may be given, before anything is played."""
    code, out = swiftbot("log", "replay", log, *options)
    assert (code, told in " ".join(out.split())) == (2, True), out
