"""The command line: help everywhere, documented exit codes, clear errors."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from cyclopts import App

from appliance import cli


def leaves(parent: App, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], App]]:
    """Yield every command that does something, with its words."""
    for name in parent:
        if not name.startswith("-"):
            if parent[name].default_command is not None:
                yield (*path, name), parent[name]
            yield from leaves(parent[name], (*path, name))


COMMANDS = dict(leaves(cli.app))
SILENT = {
    "tui", "gateway", "router", "record", "foxglove", "mcp", "up", "demo", "sim mavlink", "sim zenoh", "train fit",
    "train export", "train tune", "robots qgc-actions", "robots drive", "completion", "manual",
}  # fmt: skip
"""Commands that print no data of their own, or a file as it is."""
NEGATIVE = {"--no-clock", "--no-ray", "--no-profile", "--no-record", "--no-plain"}
"""Options that turn off what is on by default."""


def run(*arguments: str) -> int:
    """Run a command in this process and return its exit code."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_has_help(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    """`--help` shows usage and purpose, `--json` where data is printed, and no options that the parser makes up."""
    assert run(*words, "--help") == 0
    shown = capsys.readouterr().out
    assert f"Usage: swiftbot {' '.join(words)}" in shown
    assert ("--json" in shown) is (" ".join(words) not in SILENT)
    assert "--empty-" not in shown
    assert set(re.findall(r"--no-[\w-]+", shown)) <= NEGATIVE
    assert not re.search(r"^│ \*? +[A-Z][\w-]* --", shown, re.MULTILINE), "a positional argument is an option as well"
    assert COMMANDS[words].default_command.__doc__


def test_commands_that_are_named_exist(project_root: Path) -> None:
    """Documentation, help and hints name no command that is not there."""
    files = [project_root / "README.md", *project_root.glob("docs/**/*.md")]
    files += [path for room in ("appliance", "workshop", "scripts") for path in project_root.glob(f"{room}/**/*.py")]
    named = 0
    for path in files:
        text = path.read_text()
        quoted = re.findall(r"`[^`\n]*`", text)
        quoted += re.findall(r"```.*?```", text, re.DOTALL) if path.suffix == ".md" else []
        for place in re.findall(r"(?<![\w./-])swiftbot ((?:[a-z][a-z-]*)(?: [a-z][a-z-]*)?)", "\n".join(quoted)):
            named += 1
            first, _, second = place.partition(" ")
            assert first in cli.app, f"{path}: swiftbot {place}"
            group = cli.app[first]
            if group.default_command is None and second:
                assert second in group, f"{path}: swiftbot {place}"
    assert named > 100


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["frobnicate"], 2, "frobnicate"),
        (["submit"], 2, "TEXT"),
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
