"""`swiftbot tui` with its options: what the terminal UI is opened with, here and for each browser."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from appliance import cli
from appliance.tui import app
from appliance.tui import serve as serving
from appliance.tui.serve import session_command

CONNECT = ("--fleet", "yard", "--connect", "tcp/127.0.0.1:1")


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., list[tuple[Any, ...]]]:
    """Return what runs the command and returns with what a terminal UI, or the server of them, was started."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    calls: list[tuple[Any, ...]] = []

    async def run_tui(plane: Any, fleet: str, config: Any, *, replay: Path | None) -> None:
        calls.append((fleet, plane.connect, config, replay))

    async def serve(fleet: str, connect: Any, *, options: list[str], **_: object) -> None:
        calls.append((fleet, connect, options))

    monkeypatch.setattr(app, "run_tui", run_tui)
    monkeypatch.setattr(serving, "serve", serve)

    def run(*arguments: str) -> list[tuple[Any, ...]]:
        with pytest.raises(SystemExit) as ended:
            cli.main(["tui", *(() if "--fleet" in arguments else CONNECT), *arguments])
        assert ended.value.code == 0
        return calls

    return run


def test_it_is_locked_unless_asked_otherwise(opened: Callable[..., list[tuple[Any, ...]]]) -> None:
    """Without --write nothing can be changed; with it, or by a person's own file, it starts unlocked."""
    fleet, connect, config, replay = opened()[-1]
    assert (fleet, connect, config.write, replay) == ("yard", ("tcp/127.0.0.1:1",), False, None)
    assert opened("--write", "--theme", "contrast-light")[-1][2].write
    assert opened("--theme", "contrast-light")[-1][2].theme == "contrast-light"


def test_browsers_get_what_was_asked_for(opened: Callable[..., list[tuple[Any, ...]]], tmp_path: Path) -> None:
    """Theme, own settings and --write go on to each browser's terminal UI, which takes them as they are."""
    own = tmp_path / "own.toml"
    own.write_text('theme = "light"\n[keys]\npalette = "f2"\n')
    _, _, options = opened("--serve")[-1]
    assert "--write" not in options
    fleet, connect, options = opened("--serve", "--write", "--config", str(own))[-1]
    command = session_command(fleet, connect, options)
    words = command[command.index("tui") + 1 :]
    _, _, config, _ = opened(*words)[-1]
    assert (config.write, config.theme, config.keys) == (True, "light", {"palette": "f2"})


def test_logs_of_the_fleet_that_was_named_are_found(
    opened: Callable[..., list[tuple[Any, ...]]], tmp_path: Path
) -> None:
    """The folder in which a local fleet records is looked through, wherever `--dir` has it."""
    (config,) = (call[2] for call in opened("--dir", str(tmp_path / "fleet")))
    assert config.logs == (str(tmp_path / "fleet" / "record"),)
