"""Commands that other packages add to `swiftbot`, and the product's command line without them."""

import subprocess
import sys
import sysconfig
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest
from cyclopts import App

from appliance.cli import plugins

PRODUCT = ("doctor", "fleet", "gateway", "plan", "record", "submit", "task", "tui")
WORKSHOP = ("bench", "demo", "down", "sim", "train", "up")


def greet(app: App) -> None:
    """Add a command, as another package does."""
    app.command(lambda: 0, name="greet")


def _offered(monkeypatch: pytest.MonkeyPatch, **values: str) -> None:
    points = EntryPoints(EntryPoint(name, value, plugins.GROUP) for name, value in values.items())
    monkeypatch.setattr(plugins, "entry_points", lambda group: points.select(group=group))


def test_the_workshop_offers_its_commands() -> None:
    """The installed entry points add `up`, `down`, `demo`, `sim`, `bench` and `train`, and `task simulate`."""
    app = App()
    app.command(App(name="task"))
    plugins.add_to(app)
    assert set(WORKSHOP) <= set(app)
    assert "simulate" in set(app["task"])


def test_a_package_that_is_broken_is_named_and_the_others_stay(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An entry point that cannot be imported is a warning with its name and cause, on stderr."""
    _offered(monkeypatch, broken="no_such_package:add", good=f"{__name__}:greet")
    monkeypatch.setitem(sys.modules, __name__, sys.modules[greet.__module__])
    app = App()
    plugins.add_to(app)
    assert "greet" in set(app)
    told = capsys.readouterr().err
    assert "the commands of broken (no_such_package:add) are missing" in " ".join(told.split())
    assert "No module named 'no_such_package'" in " ".join(told.split())


def test_the_product_works_without_the_workshop(project_root: Path, tmp_path: Path) -> None:
    """With only the product on the path, `swiftbot --help` lists its commands and none of the workshop's."""
    (tmp_path / "appliance").symlink_to(project_root / "appliance")
    script = (
        "import sys, importlib.metadata\n"
        f"sys.path[:0] = [{str(tmp_path)!r}]\n"
        # Without `site`, the pointers to the tree (.pth) are not followed: the workshop cannot be imported.
        f"sys.path.append({sysconfig.get_paths()['purelib']!r})\n"
        "found = importlib.metadata.entry_points\n"
        "importlib.metadata.entry_points = lambda **which: found(name='none', **which)\n"
        "from appliance.cli import app, main\n"
        "assert not any(name == 'workshop' or name.startswith('workshop.') for name in sys.modules)\n"
        "print(*[name for name in app])\n"
        "main(['--help'])\n"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", script],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    names = set(done.stdout.splitlines()[0].split())
    assert set(PRODUCT) <= names
    assert not set(WORKSHOP) & names


def test_a_stop_waits_for_no_library_that_it_does_not_use() -> None:
    """The command line loads no container engine, numbers or model: they took half of the time of `swiftbot stop`."""
    heavy = {"numpy", "podman", "requests", "onnxruntime"}
    script = f"import sys, appliance.cli; print(*sorted({heavy} & {{*sys.modules}}))"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert found.stdout.split() == []
