"""What may follow on the command line: commands, options, choices, and which names of the fleet."""

import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance import cli
from appliance.cli.completion import Offer, offers


@pytest.mark.parametrize(
    ("line", "some", "kind"),
    [
        ("", {"fleet", "task", "submit", "alerts"}, ""),
        ("task ", {"list", "show", "cancel", "approve"}, ""),
        ("task show ", set(), "task"),
        ("task show t-1 ", set(), ""),
        ("task why ", set(), "task"),
        ("stop ", set(), "robot"),
        ("stop rover_1 ", set(), "robot"),
        ("drain ", set(), "gateway"),
        ("task migrate t-1/s1 --to ", set(), "gateway"),
        ("submit ", set(), "words"),
        ("submit --wait ", set(), "words"),
        ("submit --approval ", set(), ""),
        ("alerts ", {"list", "ack"}, ""),
        ("alerts ack ", set(), "alert"),
        ("robots takeover ", set(), "robot"),
        ("plan --tier ", {"auto", "local", "rules"}, ""),
        ("completion ", {"bash", "zsh", "fish"}, ""),
        ("task list -", {"--limit", "--json", "--fleet", "--dir", "--connect", "--help"}, ""),
        ("submit x --", {"--wait", "--priority", "--yes"}, ""),
    ],
)
def test_what_may_follow(line: str, some: set[str], kind: str) -> None:
    """Of a line up to the word that is being written."""
    found = offers(cli.app, line.split(" "))
    assert some <= set(found.words)
    assert found.kind == kind
    if not some and kind:
        assert not found.words


@given(
    st.lists(st.text(max_size=6) | st.sampled_from(["task", "show", "--json", "--to", "submit", "--", "-"]), min_size=1)
)
def test_no_line_breaks_it(words: list[str]) -> None:
    """Whatever has been written."""
    assert isinstance(offers(cli.app, words), Offer)


def test_a_mistyped_option_is_told_the_right_one(capsys: pytest.CaptureFixture[str]) -> None:
    """Of the command that it was given to; what is like none is left without."""
    for option, near in (("--jsn", "--json"), ("--limt", "--limit"), ("--zzzzz", "")):
        with pytest.raises(SystemExit) as ended:
            cli.main(["task", "list", option])
        said = capsys.readouterr().err
        assert ended.value.code == 2
        assert (f"did you mean {near}?" in said) is bool(near)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_has_a_script(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It asks this command with the words so far."""
    with pytest.raises(SystemExit):
        cli.main(["completion", shell])
    script = capsys.readouterr().out
    assert f"swiftbot completion {shell} -- " in script


def test_bash_completes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The script in a real bash: words come from the command, blanks in them are quoted."""
    with pytest.raises(SystemExit):
        cli.main(["completion", "bash"])
    script = tmp_path / "swiftbot.bash"
    script.write_text(capsys.readouterr().out)
    told = tmp_path / "told"
    lines = f"""
        swiftbot() {{ printf '%s\\n' "$@" > {told}; printf '%s\\n' cancel 'dock 3'; }}
        . {script}
        COMP_WORDS=(swiftbot task ca) COMP_CWORD=2
        _swiftbot
        printf '%s\\n' "${{COMPREPLY[@]}}"
        complete -p swiftbot
    """
    done = subprocess.run(["bash", "-c", lines], capture_output=True, text=True, check=True, timeout=30)
    assert done.stdout.splitlines()[:2] == ["cancel", "dock\\ 3"]
    assert "-F _swiftbot" in done.stdout
    assert told.read_text().splitlines() == ["completion", "bash", "--", "task", "ca"]
