"""`swiftbot plan --batch` as a process: an interrupt keeps what is written, the next run goes on, exit codes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

PATIENCE_S = 120.0


def command(*arguments: str) -> list[str]:
    """Return the command line of `swiftbot plan`."""
    # Where the tests run in the background of a shell, SIGINT is ignored by all that they start.
    return ["env", "--default-signal=INT", sys.executable, "-m", "appliance.cli", "plan", *arguments]


def environment(root: Path) -> dict[str, str]:
    """Return an environment in which the project is found."""
    return {**os.environ, "PYTHONPATH": str(root)}


def cases(path: Path, count: int, *more: str) -> Path:
    """Write so many cases."""
    lines = [json.dumps({"id": f"c{n}", "instruction": f"Robot_1: go to dock {n}, then hold"}) for n in range(count)]
    path.write_text("\n".join([*lines, *more]) + "\n")
    return path


def test_an_interrupt_keeps_what_is_written_and_the_next_run_goes_on(tmp_path: Path, project_root: Path) -> None:
    """SIGINT in the middle: exit code 130 and whole lines; then the same command writes the rest, each case once."""
    file, out = cases(tmp_path / "cases.jsonl", 1000), tmp_path / "out.jsonl"
    asked = command("--batch", str(file), "--out", str(out), "--tier", "rules")
    with subprocess.Popen(asked, env=environment(project_root), stderr=subprocess.PIPE, stdout=subprocess.PIPE) as run:
        give_up = time.monotonic() + PATIENCE_S
        while not out.exists() or out.read_bytes().count(b"\n") < 5:
            assert run.poll() is None, run.stderr.read() if run.stderr else ""
            assert time.monotonic() < give_up
            time.sleep(0.01)
        run.send_signal(signal.SIGINT)
        _, said = run.communicate(timeout=PATIENCE_S)
    kept = out.read_bytes()
    assert run.returncode == 130, said
    assert b"the same command continues" in said
    assert 5 <= kept.count(b"\n") < 1000
    assert kept.endswith(b"\n")
    done = subprocess.run(asked, env=environment(project_root), capture_output=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert out.read_bytes().startswith(kept)
    ids = [json.loads(line)["id"] for line in out.read_bytes().splitlines()]
    assert ids == [f"c{number}" for number in range(1000)]


@pytest.mark.parametrize(
    ("more", "code", "said"),
    [
        (("--tier", "rules"), 4, ":3: no case"),
        (("--tier", "upstream"), 2, "no upstream model"),
        (("--tier", "local", "--model", "/nonexistent"), 4, "without a plan"),
    ],
)
def test_exit_codes(more: tuple[str, ...], code: int, said: str, tmp_path: Path, project_root: Path) -> None:
    """A line that is no case is reported with its number and ends in 4; a tier that is not there in 2."""
    file = cases(tmp_path / "cases.jsonl", 2, "{no case")
    asked = command("--batch", str(file), "--out", str(tmp_path / "out.jsonl"), *more)
    done = subprocess.run(
        asked, env=environment(project_root), capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert done.returncode == code, done.stderr
    assert said in done.stderr + done.stdout


def test_text_and_batch_together_are_refused(tmp_path: Path, project_root: Path) -> None:
    """One or the other, and a batch needs both its files."""
    for arguments in (("--batch", "x"), ("go home", "--batch", "x", "--out", "y"), ()):
        done = subprocess.run(
            command(*arguments),
            env=environment(project_root), capture_output=True, text=True, check=False, timeout=PATIENCE_S,
        )  # fmt: skip
        assert done.returncode == 2, done.stderr
        assert "hint" in done.stderr


def test_a_folder_of_ones_own_is_a_skill_that_is_planned(tmp_path: Path, project_root: Path) -> None:
    """A skill that only its folder knows is planned by its phrases, reviewed, and refused where words forbid it."""
    config = tmp_path / "gateway.toml"
    config.write_text(f'id = "gw-1"\nskills = ["{project_root / "docs" / "examples" / "skills"}"]\n')
    asked = {
        "alone": "rover_1: check the battery",
        "chained": "Rover_1, go to dock 1, then check the battery",
        "courteous": "drone_1, could you please look at the battery?",
        "forbidden": "rover_1: do not check the battery",
        "excepted": "Rover_1, go to dock 1 but do not check the battery",
    }
    file, out = tmp_path / "cases.jsonl", tmp_path / "out.jsonl"
    lines = [{"id": name, "instruction": text, "robots": ["rover_1", "drone_1"]} for name, text in asked.items()]
    file.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    more = ("--config", str(config), "--site", "warehouse", "--json")
    done = subprocess.run(
        command("--batch", str(file), "--out", str(out), *more),
        env=environment(project_root), capture_output=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    found = {each["id"]: each for each in map(json.loads, out.read_text().splitlines())}
    assert set(found) == set(asked), done.stderr
    skills = {name: [each["skill"] for each in line["subtasks"]] for name, line in found.items()}
    assert [found[name]["decision"] for name in ("alone", "chained", "courteous")] == ["run"] * 3
    assert skills["alone"] == skills["courteous"] == ["battery_check"]
    assert skills["chained"] == ["goto", "battery_check"]
    assert found["forbidden"]["decision"] in ("hold", "refuse")
    assert found["excepted"]["decision"] in ("hold", "refuse") or skills["excepted"] == ["goto"]
