"""`swiftbot site`: what a file is checked for, and how a site is shown."""

import json
from pathlib import Path

import pytest

from appliance import cli

YARD = """
[places.gate]
x = 0.0
y = 0.0
aliases = ["entrance"]
[places.porch]
x = 0.2
y = 0.1
[places.hall]
x = 20.0
y = 0.0
"""


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Run a command; its exit code and what it printed."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    printed = capsys.readouterr()
    return int(str(ended.value.code)), printed.out, printed.err


def test_a_good_file_has_no_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    """The site of the product is one."""
    code, out, _ = run(capsys, "site", "check", "warehouse")
    assert (code, out) == (0, "warehouse: 17 places, 5 obstacles, 1 forbidden\nno errors, no warnings\n")


def test_what_is_most_likely_a_mistake_is_a_warning(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """No fence, places on each other, a place that nothing reaches: exit code 1, each in a line or in JSON."""
    file = tmp_path / "yard.toml"
    walls = "".join(
        f'[[obstacles]]\nname = "wall {n}"\nx = {x}\ny = {y}\n'
        for n, (x, y) in enumerate(
            (("[18.0, 22.0]", "[1.0, 2.0]"), ("[18.0, 22.0]", "[-2.0, -1.0]"), ("[18.0, 19.0]", "[-2.0, 2.0]"),
             ("[21.0, 22.0]", "[-2.0, 2.0]"))
        )
    )  # fmt: skip
    file.write_text(f'name = "yard"\n{YARD}{walls}')
    code, out, _ = run(capsys, "site", "check", str(file), "--json")
    fence, near, closed = json.loads(out)["warnings"]
    assert code == 1
    assert "no [fence]" in fence
    assert near == "gate and porch are 0.22 m apart"
    assert closed.startswith("hall: no way from gate")


def test_a_place_that_one_way_aisles_cut_off_is_a_warning(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A hall whose only aisle leads in: nobody comes back."""
    file = tmp_path / "yard.toml"
    file.write_text("""
[fence]
name = "fence"
x = [-1.0, 21.0]
y = [-1.0, 1.0]
[[aisles]]
name = "the only aisle"
x = [5.0, 15.0]
y = [-5.0, 5.0]
one_way = "east"
[[obstacles]]
name = "south"
x = [5.0, 15.0]
y = [-40.0, -1.0]
[[obstacles]]
name = "north"
x = [5.0, 15.0]
y = [1.0, 40.0]
[[obstacles]]
name = "round the hall"
x = [25.0, 26.0]
y = [-40.0, 40.0]
[[obstacles]]
name = "south of the hall"
x = [15.0, 25.0]
y = [-40.0, -39.0]
[[obstacles]]
name = "north of the hall"
x = [15.0, 25.0]
y = [39.0, 40.0]
[places.gate]
x = 0.0
y = 0.0
[places.hall]
x = 20.0
y = 0.0
""")
    code, out, _ = run(capsys, "site", "check", str(file), "--json")
    (warning,) = json.loads(out)["warnings"]
    assert code == 1
    assert warning.startswith("hall: no way to gate")
    assert "against 'the only aisle', one-way to the east" in warning


def test_a_broken_file_names_file_and_key(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """As a gateway would refuse it, before one is started with it."""
    file = tmp_path / "yard.toml"
    file.write_text(YARD.replace("x = 0.2", "x = nan"))
    code, _, problem = run(capsys, "site", "check", str(file))
    assert code not in (0, 1)
    assert "yard.toml" in problem.replace("\n", "")
    assert "places.porch.x" in problem.replace("\n", "")


def test_a_site_is_shown_with_its_map(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Map with scale, fence and limits, places with their other names."""
    file = tmp_path / "yard.toml"
    file.write_text(YARD)
    code, out, _ = run(capsys, "site", "show", str(file))
    assert code == 0
    for expected in ("├", "N↑\n", "fence: none; speed up to 8 m/s", "entrance", "20.0 0.0 0.0"):
        assert expected in out
