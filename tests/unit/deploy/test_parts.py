"""`swiftbot parts`: from what a gateway has to a signed list in force there, as an engineer goes it."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance import cli
from appliance.errors import Exit
from appliance.identity import parts
from appliance.identity.authority import Authority
from appliance.identity.bundle import Bundle
from appliance.model.roles import Role


class Typed:
    """Commands of a gateway with keys, and of its authority."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self._capsys = folder, capsys
        self.authority = Authority.create(folder / "authority", "yard", datetime.now(UTC))
        self.keys = folder / "keys" / "gateway-g1.pem"
        self.keys.parent.mkdir()
        self.authority.issue(Role.GATEWAY, "g1", out=self.keys)
        (folder / "model").mkdir()
        (folder / "model" / "genai_config.json").write_text("{}")
        (folder / "data").mkdir()
        self.config = folder / "gateway.toml"
        self.config.write_text(
            f'id = "g1"\nfleet = "yard"\ndata_dir = "{folder}/data"\nskills = []\n'
            f'[plane]\nkeys = "{self.keys}"\n[llm]\nlocal_model = "{folder}/model"\n'
        )

    def __call__(self, *words: str) -> tuple[int, str]:
        """Return exit code and all that was printed."""
        with pytest.raises(SystemExit) as ended:
            cli.main(["parts", *words])
        shown = self._capsys.readouterr()
        assert isinstance(ended.value.code, int)
        return ended.value.code, " ".join((shown.out + shown.err).split())

    def list(self, name: str = "list.json") -> Path:
        """List what is here in a file."""
        out = self.folder / name
        assert self("list", "--without-images", "--config", str(self.config), "--out", str(out))[0] == Exit.DONE
        return out

    def sign(self, *lists: Path) -> Path:
        """Sign lists."""
        out = self.folder / "signed.json"
        words = ("sign", *map(str, lists), "--out", str(out), "--authority", str(self.authority.folder))
        code, shown = self(*words)
        assert code == Exit.DONE, shown
        return out

    def check(self) -> tuple[int, str]:
        """Compare what is here with what is signed."""
        return self("check", "--without-images", "--config", str(self.config))


@pytest.fixture
def typed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Typed:
    """Commands on a gateway that has no signed list yet."""
    return Typed(tmp_path, capsys)


def test_the_way_through(typed: Typed) -> None:
    """Listed, signed, shown, installed, checked; an edit after that is found, and signing both versions allows both."""
    code, shown = typed.check()
    assert (code, "there is no" in shown) == (Exit.DENIED, True)
    first = typed.list()
    signed = typed.sign(first)
    code, shown = typed("show", str(signed), "--keys", str(typed.keys))
    assert (code, "number 1 of fleet yard" in shown) == (Exit.DONE, True)
    assert typed("install", str(signed), "--config", str(typed.config))[0] == Exit.DONE
    code, shown = typed.check()
    assert (code, "parts 1 names all" in shown) == (Exit.DONE, True)

    (typed.folder / "model" / "weights").write_text("other")
    code, shown = typed.check()
    assert (code, "model model is not signed" in shown) == (Exit.DENIED, True)
    typed("install", str(typed.sign(first, typed.list("second.json"))), "--config", str(typed.config))
    assert typed.check()[0] == Exit.DONE
    (typed.folder / "model" / "weights").unlink()
    assert typed.check()[0] == Exit.DONE


def test_json_has_it_all(typed: Typed, capsys: pytest.CaptureFixture[str]) -> None:
    """What is printed for scripts can be read back."""
    del capsys
    code, text = typed("list", "--without-images", "--config", str(typed.config), "--json")
    found: Any = msgspec.json.decode(text)
    assert code == Exit.DONE
    assert len(found["skill"]["goto"][0]) == 64
    code, text = typed("check", "--without-images", "--json")
    assert msgspec.json.decode(text)["checked"] is False  # no keys: development mode


def test_an_older_list_is_not_installed(typed: Typed) -> None:
    """It is refused with what counts and how to go back: signed again, the older one is the newest."""
    first = typed.sign(typed.list())
    old = typed.folder / "old.json"
    old.write_bytes(first.read_bytes())
    new = typed.sign(typed.list())
    counts = parts.InForce.beside(
        Bundle.load(typed.keys),
        typed.keys.parent / parts.FILE,
        kept=typed.folder / "data" / parts.FILE,
    )
    typed("install", str(new), "--config", str(typed.config))
    assert counts.text == "parts 2"
    code, shown = typed("install", str(old), "--config", str(typed.config))
    assert (code, "2 counts here" in shown, "sign the older one again" in shown) == (Exit.REFUSED, True, True)
    _, listed = typed("show", str(old), "--keys", str(typed.keys), "--json")
    again = typed.folder / "again.json"
    again.write_text(listed[listed.index("{") : listed.rindex("}") + 1])
    assert typed("install", str(typed.sign(again)), "--config", str(typed.config))[0] == Exit.DONE
    assert counts.text == "parts 3"
    assert not counts.problem


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{", "no list of parts"),
        ("{}", "names no part"),
        ('{"skill": {"goto": ["abc"]}}', "no SHA-256"),
        ('{"skill": {"goto": []}}', "no SHA-256"),
        ('{"skill": "goto"}', "no list of parts"),
    ],
)
def test_what_is_no_list_is_not_signed(typed: Typed, text: str, why: str) -> None:
    """A damaged list is refused with how to make one; nothing is signed."""
    file = typed.folder / "bad.json"
    file.write_text(text)
    code, shown = typed("sign", str(file), "--authority", str(typed.authority.folder))
    assert code == Exit.USAGE
    assert why in shown
    assert not (typed.authority.folder / parts.FILE).exists()


def test_a_strangers_list_is_not_installed(typed: Typed, tmp_path: Path) -> None:
    """One that another authority signed, one that is cut, and one that is not there; what counted stays."""
    signed = typed.sign(typed.list())
    typed("install", str(signed), "--config", str(typed.config))
    stranger = Authority.create(tmp_path / "stranger", "yard", datetime.now(UTC))
    stranger.sign_parts(parts.Parts(skill={"goto": ("0" * 64,)}), tmp_path / "theirs.json")
    (tmp_path / "cut.json").write_bytes(signed.read_bytes()[:-20])
    for name, why in (("theirs.json", "another authority"), ("cut.json", "damaged"), ("absent.json", "there is no")):
        code, shown = typed("install", str(tmp_path / name), "--config", str(typed.config))
        assert (code, why in shown) == (Exit.DENIED, True)
    assert typed.check()[0] == Exit.DONE
