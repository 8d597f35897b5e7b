"""Every command with forty hostile texts: no traceback, exit codes as documented, nothing that a terminal obeys.

Each command is run in this process with the texts where it takes texts, on a fleet that answers everything, and with
the same texts in all that it answers. Commands that would run for good, or start processes, are given them where they
are checked first. A few are run as real processes, by what a shell can pass on.
"""

# pyright: reportUnknownLambdaType=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

import asyncio
import inspect
import io
import os
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import msgspec
import pytest
from cyclopts import App
from mcap.writer import Writer

from appliance import cli, records
from appliance.cli import common, releases
from appliance.cli.printed import PRINTED
from appliance.client import FleetClient
from appliance.connection import FleetConnection
from appliance.deploy import host
from appliance.deploy.layout import Layout
from appliance.deploy.upgrade import JOURNAL, Journal, Step
from appliance.errors import ConfigError, Exit, PrerequisiteError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import ContainerInfo, GatewayStatus, RobotInfo
from appliance.model.recorder_api import RecorderStatus
from appliance.record import remote_control
from workshop import local_fleet

from .test_console_markup import filled

TEXTS = (
    "[/red] x", "[bold", "[link=file:///etc/passwd]x[/link]", ":warning:", "\\[a] [@click=app.quit]",
    "\x1b[2J\x1b[31mred", "\x9b31m", "\x07\x08\x7f", "\x1b]0;title\x07", "\x1b]8;;http://x\x1b\\y",
    "\u202eback\u202c", "\u2066a\u2069", "\u200b\u200d", "e\u0301\u0489" * 20, "\ufeffbom", "\udcff\udc80", "\ud800",
    "", " ", "\t", "a\nb\r\nc", "\x1a\x04", "x" * 700, "🤖" * 40, "機器人", "روبوت", "Ω≈ç√",
    "--", "-x", "--json", "--help me", "a=b", "*", "**/$*?#", "../../../../etc/passwd", "t-1/s2/../..",
    "NaN", "1e999", "{}", '{"id": [1, 2]}', "'\";$(reboot)`id`", "%s %n {0} {x.__class__}",
)  # fmt: skip
OBEYED = frozenset("\x1b\x9b\x07\x08\x7f\u202e\u2066")
"""Characters that a terminal obeys instead of showing them."""
CODES = frozenset(Exit)
CHECKED_FIRST = {
    "gateway": "--config", "router": "--listen", "record": "--config", "foxglove": "--config", "tui": "--theme",
    "mcp": "--port",
}  # fmt: skip
"""Daemons, and the option by which a wrong word ends them before anything is started."""
WORKSHOP = frozenset({"up", "down", "demo", "bench", "train", "sim"})
"""Commands of another package, which start processes of their own."""
MACHINE = frozenset({"doctor", "images build", "images learn", "images list"})
"""What looks at this machine or builds on it, whatever the words: Podman is none of this test's business."""


def leaves(parent: App, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], App]]:
    """Yield every command that does something, with its words."""
    for name in parent:
        if not name.startswith("-") and (path or name not in WORKSHOP):
            if parent[name].default_command is not None:
                yield (*path, name), parent[name]
            yield from leaves(parent[name], (*path, name))


RECORDS = records.Records
COMMANDS = {words: command for words, command in leaves(cli.app) if " ".join(words) not in MACHINE}


class AnyFleet:
    """A fleet that answers everything, with a text in each place that takes one, or refuses everything with it."""

    def __init__(self, text: str, *, refuses: bool) -> None:
        text = text.encode(errors="replace").decode()  # what comes as JSON has no half of a surrogate pair
        self._text, self._refuses = text, refuses
        self.operator = text[:100]
        known = {
            name: {text: filled(kind, text)} for name, kind in (("gateways", GatewayStatus), ("robots", RobotInfo))
        }
        registry = SimpleNamespace(**known, containers={text: {text: filled(ContainerInfo, text)}})
        session = SimpleNamespace(publish=lambda *_, **__: None)
        self.plane = SimpleNamespace(registry=registry, members=lambda: frozenset({text}), session=session)

    def known_robots(self) -> Any:
        """Return the robot."""
        return self.plane.registry.robots

    async def __aenter__(self) -> "AnyFleet":
        return self

    async def __aexit__(self, *_: object) -> None:
        """Nothing is open."""

    def __getattr__(self, name: str) -> Any:
        method = getattr(FleetClient, name, None) or getattr(RECORDS, name)
        text, refuses = self._text, self._refuses
        if inspect.isasyncgenfunction(method):
            kind = get_args(get_type_hints(method)["return"])[0]

            async def stream(*_: Any, **__: Any) -> AsyncIterator[Any]:
                if refuses:
                    raise RefusedError(text, remedy=text)
                yield filled(kind, text)

            return stream
        if not inspect.iscoroutinefunction(method):
            return lambda *_, **__: False
        kind = get_type_hints(method)["return"]

        async def answer(*_: Any, **__: Any) -> Any:
            await asyncio.sleep(0)
            if refuses:
                raise UnreachableError(text, remedy=text)
            return answer_of(kind, text)

        return answer


def answer_of(kind: Any, text: str) -> Any:
    """Return an answer of a type; of answers by gateway also why another did not."""
    if get_origin(kind) is tuple and dict[str, SwiftbotError] in get_args(kind):
        return tuple(
            {text: RefusedError(text, remedy=text)} if each == dict[str, SwiftbotError] else answer_of(each, text)
            for each in get_args(kind)
        )
    if kind is str:
        return text
    return filled(kind, text)


def places(command: App) -> tuple[int, list[str]]:
    """Return how many texts a command has to be given, and its options that take some."""
    required, options = 0, []
    for name, each in inspect.signature(command.default_command).parameters.items():  # pyright: ignore[reportArgumentType]
        kind = get_args(each.annotation)[0] if get_origin(each.annotation) is Annotated else each.annotation
        if each.kind in (each.POSITIONAL_ONLY, each.VAR_POSITIONAL):
            required += each.default is each.empty
        elif kind in (str, Path) or str in get_args(kind) or Path in get_args(kind):
            shown = next((one.name[0] for one in get_args(each.annotation)[1:] if getattr(one, "name", ())), None)
            options.append(shown or f"--{name.replace('_', '-')}")
    return required, options


def lines_of(words: tuple[str, ...], step: int) -> Iterator[tuple[str, list[str]]]:
    """Yield a command line for one text of `step`: in all arguments, and in one option after the other.

    The texts of the next command are those beside them, so that each text is given to many commands.
    """
    required, options = places(COMMANDS[words])
    if words[0] in CHECKED_FIRST:
        required, options = 0, [CHECKED_FIRST[words[0]]]
    for number, text in enumerate(TEXTS[list(COMMANDS).index(words) % step :: step]):
        line = [*words, *([text] * required)]
        if options:
            line += [options[number % len(options)], text]
        yield text, line


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[str, bool]]:
    """Have commands speak to a fleet that answers the text that is put into the list, or refuses with it."""
    said: list[tuple[str, bool]] = [("", False)]

    def made(*_: Any, **__: Any) -> AnyFleet:
        return AnyFleet(said[-1][0], refuses=said[-1][1])

    monkeypatch.setattr(common, "FleetClient", made)
    monkeypatch.setattr(records, "Records", made)

    async def trigger(*_: Any, **__: Any) -> list[RecorderStatus]:
        text, refuses = said[-1]
        return [] if refuses else [filled(RecorderStatus, text)]

    async def none_starts(*_: Any, **__: Any) -> None:
        raise PrerequisiteError(said[-1][0], remedy="set it up")

    monkeypatch.setattr(remote_control, "trigger", trigger)
    monkeypatch.setattr(local_fleet, "up", none_starts)
    # Nobody's releases are changed by a test that runs as root: upgrade and rollback refuse this machine's own.
    monkeypatch.setattr(releases, "os", SimpleNamespace(getuid=lambda: 1000, environ=os.environ))
    monkeypatch.setattr(FleetConnection, "open", lambda *_: pytest.fail("a command connects by itself"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SWIFTBOT_CONNECT", "tcp/127.0.0.1:1")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"")))
    return said


def run(line: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Run a command line in this process; returns its exit code and all that it has said."""
    with pytest.raises(SystemExit) as ended:
        cli.main(line)
    said = capsys.readouterr()
    assert isinstance(ended.value.code, int)
    return ended.value.code, said.out + said.err


@pytest.mark.parametrize("step", [4, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_no_text_breaks_a_command(
    words: tuple[str, ...], step: int, fleet: list[tuple[str, bool]], capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever it is given and whatever the fleet answers, it ends with a documented code and says nothing obeyed."""
    for number, (text, line) in enumerate(lines_of(words, step)):
        fleet.append((text, number % 2 == 1))
        code, said = run(line, capsys)
        assert code in CODES, (line, said)
        assert "Traceback" not in said, line
        if "--json" not in line:
            assert not OBEYED & set(said), (line, said)


PATHS = (".", "..", "folder", "/dev/null/x", "/proc/none/x", "x" * 300, f"folder/{'y' * 250}", "a\0b")
"""No names, folders, what is below a file or where nothing can be written, and what no file can be called."""
WITH_PATHS = (
    "backup @ --config a.toml --without-volumes", "backup b --config @ --without-volumes",
    "backup b --config a.toml --without-volumes --passphrase-file @",
    "restore @ --without-volumes", "restore a.toml --root @", "restore a.toml --passphrase-file @",
    "support @ --config none.toml", "support folder --config @",
    "upgrade @ --root folder", "upgrade a.toml --root @", "upgrade a.toml --root folder --config @",
    "rollback --root @", "rollback --root folder --config @",
    "release list --root @", "release show @", "release show a.toml --trusted @", "release key @",
    "release pack @ --key a.key --out b --tree source", "release pack packed --key @ --out b --tree source",
    "release pack packed --key a.key --out @ --tree source", "release pack packed --key a.key --out b --tree @",
    "log info @", "log recover @", "log recover a.mcap @", "log merge @ --out b", "log merge a.mcap --out @",
    "log trim @ --out b", "log trim a.mcap --out @", "log cat @", "log pin @", "log check @", "log replay @",
    "keys show @", "learn data check @", "learn export x @", "task export @", "task check @",
    "task approve x --hash 0123456789 --plan @",
    "plan --batch @ --out b", "plan --batch a.toml --out @", "plan --batch a.toml --out b --config @",
    "submit --file @ --yes", "plane put x --file @",
    "robots qgc-actions --config @", "robots qgc-actions --config a.toml --out @",
    "gateway --config @", "record --config @", "foxglove --config @", "tui --config @", "tui --replay @",
    "router --listen x --keys @", "images fetch x --skills @",
    "parts list --without-images --config @", "parts list --without-images --out @", "parts sign @", "parts show @",
    "parts show --keys @", "parts check --without-images --config @", "parts install @ --config a.toml",
    "parts install a.toml --config @", "manual @", "alerts test --config @",
)  # fmt: skip
"""Command lines with each path that a command takes, the others good, so that this one is reached."""


@pytest.mark.parametrize("line", WITH_PATHS)
def test_no_path_breaks_a_command(
    line: str, fleet: list[tuple[str, bool]], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Whatever the file system says to a path, the command ends with a documented code and says what is wrong."""
    fleet.append(("x", False))
    monkeypatch.setenv("SWIFTBOT_PASSPHRASE", "long enough for a key")
    work = tmp_path / "work"
    for folder in ("folder", "packed/wheels", "source"):
        (work / folder).mkdir(parents=True)
    (work / "a.toml").write_text(f'id = "gw-1"\ndata_dir = "{tmp_path}/data"\n')
    (work / "packed/wheels/swiftbot-1.whl").write_text("program")
    (work / "source/pyproject.toml").write_text('[project]\nversion = "1.0"\n')
    with (work / "a.mcap").open("wb") as file:
        Writer(file).finish()
    monkeypatch.chdir(work)
    run(["release", "key", "a.key"], capsys)
    for path in PATHS:
        words = [path if word == "@" else word for word in line.split()]
        code, said = run(words, capsys)
        assert code in CODES, (words, said)
        assert "Traceback" not in said, words
        if path in ("x" * 300, "a\0b"):
            assert code == Exit.USAGE, (words, said)
            assert "is no path" in said, (words, said)
            assert "hint: name another file or folder" in said, (words, said)


@pytest.mark.parametrize(
    ("path", "good"),
    [("機" * 85, True), ("機" * 86, False), ("ab/" * 1365, True), ("a/" * 2048 + "ab", False), ("", True), ("/", True)],
)
def test_paths_are_measured_as_linux_does(path: str, good: bool) -> None:
    """A name has 255 bytes at most, a path 4,095, whatever characters they are made of; also in a list of paths."""
    for value in (Path(path), (Path("a"), Path(path))):
        if good:
            common.check_path(Path, value)
        else:
            with pytest.raises(ConfigError, match="is no path"):
                common.check_path(Path, value)


def takes_path(command: App) -> bool:
    """Whether a command has a parameter of its own that is a path."""
    kinds = [each.annotation for each in inspect.signature(command.default_command).parameters.values()]  # pyright: ignore[reportArgumentType]
    plain = [get_args(kind)[0] if get_origin(kind) is Annotated else kind for kind in kinds]
    return any(kind is Path or Path in get_args(kind) for kind in plain)


def test_each_command_that_takes_a_path_is_tried_with_some() -> None:
    """None is missing in the table, but what would fill a folder with data, serve or simulate with a good one."""
    tried = {words for words in COMMANDS for line in WITH_PATHS if line.startswith(" ".join(words) + " ")}
    missing = {" ".join(words) for words, command in COMMANDS.items() if takes_path(command) and words not in tried}
    assert missing == {"learn data make", "mcp", "site check", "site show", "task simulate"}


class Unattended(host.Machine):
    """This machine without its services: none of those that run here is stopped."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.systemd = False


def made_first(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> list[str]:
    """Make what a command of this machine works on; returns its arguments: it does its real work on real files."""
    monkeypatch.setenv("SWIFTBOT_PASSPHRASE", "long enough for a key")
    monkeypatch.setattr(host, "Machine", Unattended)
    config, root = folder / "etc/gateway.toml", folder / "root"
    (folder / "data").mkdir()
    config.parent.mkdir()
    config.write_text(f'id = "gw-1"\ndata_dir = "{folder}/data"\n')
    wheel = folder / "packed/wheels/swiftbot-1.whl"
    wheel.parent.mkdir(parents=True)
    wheel.write_text("program")
    layout = Layout(root)
    for version in ("1.0", "2.0"):
        layout.switch(layout.finish(layout.stage(version), version, version))
    key, bundle, kept = (str(folder / name) for name in ("a.key", "a.bundle", "a.backup"))
    back_up = [kept, "--config", str(config), "--without-volumes"]
    here = ["--root", str(root), "--config", str(config)]
    first: list[list[str]] = []
    if command == "restore":
        first = [["backup", *back_up]]
    if command == "release show":
        source = str(Path(cli.__file__).parents[2])
        pack = ["release", "pack", str(folder / "packed"), "--key", key, "--out", bundle, "--tree", source]
        first = [["release", "key", key], pack]
    if command == "upgrade":
        cut_off = Journal(source="1.0", target="2.0", step=Step.SWITCH)
        (layout.prefix / JOURNAL).write_bytes(msgspec.json.encode(cut_off))
    for line in first:
        code, said = run(line, capsys)
        assert code == Exit.DONE, (line, said)
    return {
        "backup": back_up,
        "restore": [kept, "--root", str(folder / "restored"), "--without-volumes"],
        "support": [str(folder / "support.tar.gz"), "--config", str(folder / "none.toml")],
        "release show": [bundle, "--trusted", f"{key}.pub"],
        "rollback": here,
        "upgrade": ["--resume", *here],
    }[command]


OF_MACHINE = frozenset({"backup", "restore", "support", "release show", "rollback", "upgrade"})


@pytest.mark.parametrize("command", PRINTED)
def test_json_is_what_its_schema_says(
    command: str, fleet: list[tuple[str, bool]], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """What a command prints is read back as its type, and has all fields of it."""
    words = tuple(command.split())
    required, _ = places(COMMANDS[words])
    plan = tmp_path / "plan.json"
    plan.write_text('{"domain": "d", "subtasks": []}')
    given = {
        "task check": [str(plan)], "llm swap": ["x", "x"], "alerts ack": ["x"], "plan": ["x: go"],
            "submit": ["x: go"],
        "schedule add": ["x: go"], "schedule show": ["x"],
        "learn start": ["clips"], "learn why": ["x", "x"], "learn mark": ["x", "1"], "learn unmark": ["x", "1"],
    }  # fmt: skip
    options = {
        "task approve": ["--hash", "0123456789"], "robots links add": ["--connect"],
        "schedule add": ["--every", "1h", "--name", "x"], "rules add": ["--place", "x"],
    }  # fmt: skip
    fleet.append(("x", False))
    arguments = given.get(command) or (["udp://x:1"] if command.startswith("robots links ") else ["x/x"]) * required
    if command in ("robots links", "robots links list"):
        arguments = []
    if command in OF_MACHINE:
        arguments = made_first(command, tmp_path, monkeypatch, capsys)
    lease = ["--lease", "x"] if command in ("robots renew", "robots release") else []
    with pytest.raises(SystemExit):
        cli.main([*words, *arguments, *options.get(command, []), *lease, "--json"])
    said = capsys.readouterr()
    value = msgspec.json.decode(said.out, type=PRINTED[command])
    assert msgspec.json.decode(said.out) == common.complete(value), said.err


BYTES = (b"\xff\xfe", b"\x1b[2J\x1b]0;x\x07", "\u202eback".encode(), b"[/red] x", b"-x")
"""What a shell can pass on, and this process could not give itself."""


def test_no_bytes_break_the_real_command(tmp_path: Path) -> None:
    """The same as a process of its own: wrong encodings, escape sequences and markup end in words and an exit code."""
    lines = [
        *((("fleet", "--dir"), text) for text in BYTES[:3]),
        (("log", "info"), BYTES[3]),
        (("no-such-command",), BYTES[4]),
    ]
    environment = {"PATH": os.environ["PATH"], "HOME": str(tmp_path), "PYTHONPATH": str(Path(cli.__file__).parents[2])}
    running = [
        subprocess.Popen(
            [sys.executable, "-m", "appliance.cli", *words, text], cwd=tmp_path, env=environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )
        for words, text in lines
    ]  # fmt: skip
    for line, process in zip(lines, running, strict=True):
        said = process.communicate()[0].decode()
        assert process.returncode in {Exit.USAGE, Exit.REFUSED}, (line, said)
        assert "Traceback" not in said
        assert said.strip()
        assert not OBEYED & set(said)
