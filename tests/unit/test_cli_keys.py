"""`swiftbot keys`: the way from no authority to a revoked member, as a person goes it."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance import cli
from appliance.errors import Exit


class Typed:
    """Runs commands on an authority in a folder."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capsys = capsys

    def __call__(self, *words: str) -> tuple[int, str]:
        """Return exit code and all that was printed."""
        with pytest.raises(SystemExit) as ended:
            cli.main(["keys", *words, "--authority", str(self.folder)])
        shown = self._capsys.readouterr()
        assert isinstance(ended.value.code, int)
        return ended.value.code, " ".join((shown.out + shown.err).split())

    def json(self, *words: str) -> Any:
        """Return what a command prints with --json."""
        return msgspec.json.decode(self(*words, "--json")[1])


@pytest.fixture
def typed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Typed:
    """Commands on an authority that is not there yet."""
    return Typed(tmp_path / "authority", capsys)


def test_the_way_through(typed: Typed) -> None:
    """Made, issued, listed, shown, renewed, revoked; each with what comes next."""
    assert "keys issue gateway" in typed("init", "--fleet", "yard")[1]
    issued = typed.json("issue", "gateway", "gw-1", "--host", "10.0.0.1")
    assert (issued["fleet"], issued["role"], issued["hosts"]) == ("yard", "gateway", ["10.0.0.1"])
    code, shown = typed("show", issued["file"])
    assert (code, "gateway gw-1 of fleet yard" in shown) == (Exit.DONE, True)
    renewed = typed.json("renew", "gateway", "gw-1", "--days", "10")
    assert renewed["file"] == issued["file"]
    assert typed.json("show", renewed["file"])["expiring"] is True
    assert [each["days_left"] for each in typed.json("list")] == [10.0, 365.0]
    assert len(typed.json("revoke", "gateway", "gw-1", "--why", "stolen")["revoked"]) == 2
    assert typed.json("list") == []
    assert {each["why"] for each in typed.json("list", "--all")} == {"stolen"}
    code, shown = typed("show", renewed["file"])
    assert (code, "revoked: stolen" in shown) == (Exit.DENIED, True)


def test_mistakes_name_the_remedy(typed: Typed, tmp_path: Path) -> None:
    """No authority, a name that is taken, no such role, a file that is none."""
    code, shown = typed("issue", "viewer", "ann")
    assert (code, "swiftbot keys init" in shown) == (Exit.DENIED, True)
    typed("init")
    typed("issue", "viewer", "ann")
    code, shown = typed("issue", "viewer", "ann")
    assert (code, "keys renew viewer ann" in shown) == (Exit.REFUSED, True)
    code, shown = typed("issue", "captain", "ann")
    assert (code, "operator" in shown) == (Exit.USAGE, True)
    (tmp_path / "text").write_text("no keys")
    (tmp_path / "text").chmod(0o600)
    code, shown = typed("show", str(tmp_path / "text"))
    assert (code, "no file of keys" in shown) == (Exit.DENIED, True)


def test_a_fleet_that_cannot_be_reached_is_said_and_the_certificate_is_revoked(typed: Typed, free_port: int) -> None:
    """The robot may move: the operator is told to use its switch, and what to do about the gateways."""
    typed("init", "--fleet", "yard")
    typed("issue", "robot", "drone_1")
    keys = typed.json("issue", "operator", "ann")["file"]
    where = ("--connect", f"tls/127.0.0.1:{free_port}", "--keys", keys)
    code, shown = typed("revoke", "robot", "drone_1", "--fleet", "yard", *where)
    assert code == Exit.FAILED
    assert "drone_1 was not told to hold" in shown
    assert "use its switch" in shown
    assert "the fleet does not have the roster" in shown
    assert [each["name"] for each in typed.json("list")] == ["ann"]
    assert typed("publish", *where)[0] != Exit.DONE


def test_without_a_gateway_the_next_step_is_named(typed: Typed) -> None:
    """A revocation is made in the authority's folder alone, and publishing needs an address."""
    typed("init", "--fleet", "yard")
    typed("issue", "robot", "drone_1")
    code, shown = typed("revoke", "robot", "drone_1")
    assert (code, "swiftbot keys publish" in shown) == (Exit.DONE, True)
    code, shown = typed("publish")
    assert (code, "--connect" in shown) == (Exit.USAGE, True)
