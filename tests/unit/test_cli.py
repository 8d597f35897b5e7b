"""The command line: help everywhere, documented exit codes, clear errors."""

from pathlib import Path

import pytest

from appliance import cli

COMMANDS = [
    "up", "down", "demo", "gateway", "record", "plan", "submit", "task list", "task show", "task cancel", "task watch",
    "task why", "fleet",
    "pool", "robots list", "robots qgc-actions", "log info", "log replay", "log recover",
    "log merge", "log trim", "log cat", "log pin", "log check", "log trigger",
    "sim mavlink", "sim zenoh", "images build", "images list",
    "images fetch", "doctor", "tui", "bench tui",
    "bench startup", "bench rate", "bench refill", "bench soak", "bench zygote",
    "bench transfer",
    "bench table", "pool list", "pool why", "pool warm", "pool evict", "pool release", "pool decisions",
    "plane get", "plane put", "plane rm", "plane ls",
]  # fmt: skip


def run(*arguments: str) -> int:
    """Run a command in this process and return its exit code."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """`--help` ends with 0 and shows the usage."""
    assert run(*command.split(), "--help") == 0
    assert "Usage: swiftbot" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["frobnicate"], 2, "frobnicate"),
        (["submit"], 2, "text"),
        (["up", "--robots", "cats=1", "--dir", "{tmp}"], 2, "mavlink=1,zenoh=1"),
        (["fleet", "--dir", "{tmp}"], 4, "swiftbot up"),
        (["fleet", "--connect", "tcp/127.0.0.1:1"], 3, "tcp/127.0.0.1:1"),
        (["task", "watch", "t-1", "--since", "yesterday"], 2, "is no time"),
        (["log", "info", "{tmp}/none.mcap"], 4, "none.mcap"),
        (["log", "replay", "{tmp}/none.mcap"], 4, "none.mcap"),
        (["gateway", "--config", "{tmp}/none.toml"], 2, "none.toml"),
        (["plane", "put", "k", "v", "--new", "--expect", "{{}}"], 2, "exclude"),
        (["plane", "put", "k", "v", "--stdin"], 2, "leave all but one out"),
        (["plane", "put", "k", "--file", "{tmp}/none"], 4, "none"),
        (["plane", "ls", "--limit", "0"], 2, "1 to 1,000"),
        (["plane", "ls", "--connect", "tcp/127.0.0.1:1"], 3, "tcp/127.0.0.1:1"),
        (["bench", "rate", "--rates", "0"], 2, "above 0"),
        (["bench", "table", "{tmp}/none.json"], 4, "none.json"),
        (["sim", "mavlink", "--to", "nowhere"], 2, "nowhere"),
        (["sim", "mavlink", "--to", "udp://127.0.0.1:1", "--site", "atlantis"], 2, "atlantis"),
    ],
)
def test_mistakes_end_with_the_documented_code_and_a_reason(
    arguments: list[str], code: int, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The message names what was wrong, without a traceback."""
    assert run(*(each.format(tmp=tmp_path) for each in arguments)) == code
    shown = capsys.readouterr()
    assert told in " ".join((shown.out + shown.err).split())
    assert "Traceback" not in shown.err
