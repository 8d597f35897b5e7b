"""Manual pages say what the help says, as man(7) wants it."""

import re
import subprocess
from pathlib import Path

import pytest
from cyclopts import App

from appliance.cli import app
from appliance.cli.manual import pages
from appliance.errors import ConfigError, Exit

REQUESTS = {".TH", ".SH", ".SS", ".PP", ".TP", ".B"}


def test_each_word_of_the_command_line_has_a_page_and_each_command_stands_on_one() -> None:
    """Nothing that can be typed is missing."""
    found = pages(app)
    words = [name for name in app if not name.startswith("-")]
    assert set(found) == {"swiftbot", *(f"swiftbot-{word}" for word in words)}
    assert '.SS "swiftbot task show TASK"' in found["swiftbot-task"]
    assert "Task ID." in found["swiftbot-task"]
    assert ".B \\-\\-wait" in found["swiftbot-submit"]
    assert all(f".B {int(code)}\n" in found["swiftbot"] for code in Exit)


def test_only_known_requests_begin_with_a_point() -> None:
    """No text of a help is taken for a request."""
    for name, text in pages(app).items():
        begun = {line.split(" ")[0] for line in text.splitlines() if line.startswith((".", "'"))}
        assert begun <= REQUESTS, name
        assert text.count(".SH NAME") == 1
        assert not re.search(r"\\(?![e&\-(])", text), name


def test_text_that_looks_like_a_request_is_text() -> None:
    """Points, quotes and backslashes of a help are printed as they are."""
    hostile = App(name="swiftbot", help="Program.")
    task = App(name="task", help='.sy rm -rf / \\n "quoted"\n\n\'second')
    task.command(lambda: None, name="show")
    hostile.command(task)
    text = pages(hostile)["swiftbot-task"]
    assert "\n\\&.sy rm \\-rf / \\en \\(dqquoted\\(dq\n" in text
    assert "\n\\&'second\n" in text


def test_groff_reads_them_without_a_warning(tmp_path: Path) -> None:
    """Each page that the command writes is well-formed."""
    assert app(["manual", str(tmp_path / "man1")], result_action="return_value") == Exit.DONE
    written = sorted((tmp_path / "man1").glob("*.1"))
    assert len(written) == len(pages(app))
    read = subprocess.run(
        ("groff", "-ww", "-man", "-Kutf8", "-Tutf8", "-z", *map(str, written)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (read.returncode, read.stderr) == (0, "")


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    """The error names the path and what to do."""
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="file"):
        app(["manual", str(tmp_path / "file" / "man1")], result_action="return_value")
