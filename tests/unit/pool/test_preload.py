"""What a zygote loads beforehand: what runs get of it, and what happens to what hangs, crashes or eats memory."""

import sys
import textwrap
import threading
import types
from pathlib import Path
from typing import Any

import pytest

from appliance.pool.runner import preload
from appliance.pool.runner.link import CallError, Fail
from appliance.pool.runner.preload import Loaded
from appliance.pool.runner.spec import Spec

RUN = "\ndef run(ctx):\n    return {}\n"
DEAF = """
import signal
def preload(ctx):
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])  # as what hangs in C would be
    while True:
        pass
"""


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that loads handlers, given by name, as a zygote would; further tables by name too."""
    monkeypatch.setattr(preload.gc, "freeze", lambda: None)  # this process is no zygote
    monkeypatch.setattr(preload, "make_pages_huge", lambda: None)  # and its heap is that of all tests

    def do(handlers: dict[str, str], *, proven: bool = False, **tables: dict[str, Any]) -> Loaded:
        skills: dict[str, Any] = {}
        for name, text in handlers.items():
            folder = tmp_path / "skills" / name
            folder.mkdir(parents=True)
            (folder / "handler.py").write_text(textwrap.dedent(text) + RUN)
            skills[name] = {"folder": str(folder), "preload_mb": 50, "preload_s": 20.0, **tables.get(name, {})}
        (tmp_path / "volumes" / "maps").mkdir(parents=True)
        table = {"skills": skills, "site": {"name": "yard"}, "volumes": str(tmp_path / "volumes"), "patience_s": 30.0}
        loaded = Loaded(Spec(table | {"proven": proven}))
        loaded.load()
        return loaded

    return do


def test_what_preload_returns_is_there_for_runs(load: Any, tmp_path: Path) -> None:
    """`preload` sees the site, its folder and its volumes; a mapped file is the file's bytes."""
    (tmp_path / "skills").mkdir()
    (tmp_path / "grid.bin").write_bytes(b"grid")
    text = f"""
    def preload(ctx):
        (ctx.volume("maps") / "x").write_text("y")
        return [ctx.site["name"], ctx.folder.name, bytes(ctx.map({str(tmp_path / "grid.bin")!r}))]
    """
    loaded = load({"good": text})
    assert loaded.problems == {}
    module, value = loaded.handler(loaded.spec.skills["good"])
    assert value == ["yard", "good", b"grid"]
    assert callable(module.run)
    assert (tmp_path / "volumes" / "maps" / "x").read_text() == "y"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("import time\ndef preload(ctx):\n    time.sleep(60)\n", "did not end within 0.3 s"),
        ("import os, signal\ndef preload(ctx):\n    os.kill(os.getpid(), signal.SIGKILL)\n", "killed by SIGKILL"),
        ("import os\ndef preload(ctx):\n    os._exit(3)\n", "left with status 3"),
        ("def preload(ctx):\n    return bytearray(b'x') * (90 * 2**20)\n", "preload_mb allows 50"),
        ("def preload(ctx):\n    return bytearray(2**33)\n", "MemoryError"),
        (DEAF, "did not end within 0.3 s"),
    ],
)
def test_what_must_be_ended(load: Any, text: str, reason: str) -> None:
    """What hangs, crashes or eats memory is left out with its reason, its runs are reported, and all else is loaded."""
    limit_s = 0.3 if "0.3 s" in reason else 20.0
    loaded = load({"bad": text, "good": "def preload(ctx):\n    return 1\n"}, bad={"preload_s": limit_s})
    assert set(loaded.problems) == {"preload bad"}
    assert reason in loaded.problems["preload bad"]
    assert loaded.handler(loaded.spec.skills["good"])[1] == 1
    with pytest.raises(CallError, match="could not be loaded") as caught:
        loaded.handler(loaded.spec.skills["bad"])
    assert caught.value.code == "preload"
    assert "preload_mb" in caught.value.remedy


def test_an_import_that_crashes(load: Any) -> None:
    """A handler that takes its process along while it is imported is left out, and all else is loaded."""
    loaded = load({"bad": "import os\nos._exit(1)\n", "good": ""})
    assert loaded.problems == {"bad": "ended: left with status 1"}
    assert set(loaded.handlers) == {"good"}


def test_a_file_that_comes_later(load: Any, tmp_path: Path) -> None:
    """Loading that failed for want of a file is tried again by each run, and works when the file is there."""
    text = "def preload(ctx):\n    return (ctx.volume('maps') / 'yard').read_text()\n"
    loaded = load({"late": text}, late={"loads": ["maps:yard"]})
    assert loaded.problems == {"preload late": "FileNotFoundError: maps:yard is not there"}
    skill = loaded.spec.skills["late"]
    with pytest.raises(FileNotFoundError, match="maps:yard"):
        loaded.handler(skill)
    (tmp_path / "volumes" / "maps" / "yard").write_text("grid")
    assert loaded.handler(skill)[1] == "grid"


def test_preload_without_leave(load: Any) -> None:
    """A `preload` that the manifest gives no memory is not called, and that is reported."""
    loaded = load({"greedy": "def preload(ctx):\n    raise AssertionError\n"}, greedy={"preload_mb": 0})
    assert "set preload_mb" in loaded.problems["preload greedy"]


def test_a_volume_that_is_not_there(load: Any) -> None:
    """A volume that is not mounted, or a path in place of a name, is refused with the remedy."""
    loaded = load({"a": "def preload(ctx):\n    ctx.volume('none')\n"})
    assert "there is no volume 'none'" in loaded.problems["preload a"]
    around = preload.Surroundings(loaded.spec.skills["a"], loaded.spec)
    with pytest.raises(Fail, match="no volume"):
        around.volume("../skills")


def test_threads_are_told(load: Any) -> None:
    """A thread that is running when the zygote forks would be lost: who started it is reported."""
    text = """
    import threading
    stop = threading.Event()
    threading.Thread(target=stop.wait, daemon=True).start()
    """
    loaded = load({"threaded": text}, proven=True)
    try:
        assert set(loaded.problems) == {"threads of threaded"}
        assert "1 threads" in loaded.problems["threads of threaded"]
    finally:
        loaded.handlers["threaded"].stop.set()


def test_a_thread_that_ends_meanwhile(load: Any) -> None:
    """A thread that ends while a handler starts one hides nothing."""
    ending, stop = threading.Event(), threading.Event()
    before = threading.Thread(target=ending.wait, daemon=True)
    before.start()
    sys.modules["before"] = types.SimpleNamespace(thread=before, ending=ending, stop=stop)  # type: ignore[assignment]
    text = """
    import threading
    import before
    threading.Thread(target=before.stop.wait, daemon=True).start()
    before.ending.set()
    before.thread.join()
    """
    try:
        assert "1 threads" in load({"threaded": text}, proven=True).problems["threads of threaded"]
    finally:
        stop.set()
        del sys.modules["before"]


def test_a_proven_make_is_not_rehearsed(load: Any, tmp_path: Path) -> None:
    """What came up well before is loaded once; the first time it is loaded twice, in a child first."""
    text = f"def preload(ctx):\n    with open({str(tmp_path / 'count')!r}, 'a') as file:\n        file.write('x')\n"
    load({"a": text}, proven=True)
    assert (tmp_path / "count").read_text() == "x"
