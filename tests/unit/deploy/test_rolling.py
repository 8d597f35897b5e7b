"""A fleet is upgraded one gateway after the other: drained before, stopped at the first failure, the rest untouched."""

import os
import stat
from collections.abc import Callable
from pathlib import Path

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.deploy import rolling
from appliance.deploy.rolling import Rolled, Ssh, roll
from appliance.deploy.upgrade import Ended
from appliance.errors import ConfigError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import GatewayStatus

pytestmark = pytest.mark.anyio
NAMES = ("g1", "g2", "g3")
TARGETS = {name: f"root@{name}" for name in NAMES}
NEW = Ended(release="1.1.0", before="1.0.0")
BACK = Ended(release="1.0.0", before="", rolled_back=True, problem="gateway did not stay up")


class FakeFleet:
    """Gateways and their machines; `outcomes` say what becomes of an upgrade, `returns` who is there afterwards."""

    def __init__(self, outcomes: dict[str, Ended | SwiftbotError] | None = None) -> None:
        self.here = {name: GatewayStatus(id=name, fleet="f", started_ns=1, pid=1) for name in NAMES}
        self.outcomes = outcomes or {}
        self.returns = set(NAMES)
        self.did: list[str] = []
        self.rounds = 2
        self.runs: dict[str, str] = {}

    def gateways(self) -> dict[str, GatewayStatus]:
        """Return those that are there."""
        return dict(self.here)

    def _now(self, name: str, **changes: object) -> None:
        self.here[name] = GatewayStatus(**{  # type: ignore[arg-type]
            "id": name, "fleet": "f", "started_ns": self.here[name].started_ns, "pid": 1, **changes,
        })  # fmt: skip

    async def drain(self, gateway: str) -> bool:
        """Drain it, in a few rounds."""
        self.did.append(f"drain {gateway}")
        self._now(gateway, draining=True)
        return self.did.count(f"drain {gateway}") >= self.rounds

    async def undrain(self, gateway: str) -> None:
        """Let it take runs again."""
        self.did.append(f"undrain {gateway}")
        self._now(gateway)

    async def running(self, destination: str) -> str:
        """Return what runs there."""
        return self.runs.get(destination, "1.0.0")

    async def copy(self, destination: str, file: Path) -> str:
        """Copy the bundle."""
        self.did.append(f"copy {destination}")
        return f"/there/{file.name}"

    async def upgrade(self, destination: str, path: str, *, older: bool) -> Ended:
        """Upgrade: the gateway is started again."""
        assert path == "/there/b"
        assert not older
        name = destination.partition("@")[2]
        self.did.append(f"upgrade {name}")
        outcome = self.outcomes.get(name, NEW)
        if isinstance(outcome, SwiftbotError):
            raise outcome
        if name in self.returns:
            self._now(name, started_ns=2)
        return outcome

    async def roll(self, targets: dict[str, str] = TARGETS) -> tuple[Rolled, ...]:
        """Upgrade them."""

        async def sleep(_: float) -> None: ...

        return await roll(self, self, targets, Path("b"), release="1.1.0", say=lambda _: None, sleep=sleep)


async def test_one_after_the_other_each_drained_before() -> None:
    """In the order of their names; the next begins when the one before is back."""
    fleet = FakeFleet()
    assert [(each.gateway, each.state) for each in await fleet.roll()] == [(name, "upgraded") for name in NAMES]
    expected: list[str] = []
    for name in NAMES:
        expected += [f"copy root@{name}", f"drain {name}", f"drain {name}", f"upgrade {name}"]
    assert fleet.did == expected


@given(st.sampled_from(NAMES), st.sampled_from(["goes back", "error", "does not return"]))
def test_the_first_failure_ends_it(name: str, how: str) -> None:
    """Those before stay upgraded, those behind are not touched, the one that failed takes runs again if it is there."""
    fleet = FakeFleet({"goes back": {name: BACK}, "error": {name: UnreachableError("ssh ended")}}.get(how, {}))
    if how == "does not return":
        fleet.returns.discard(name)
    rolled = anyio.run(fleet.roll)
    place = NAMES.index(name)
    assert [each.state for each in rolled] == ["upgraded"] * place + ["failed"] + ["not touched"] * (2 - place)
    assert not any(other in step for other in NAMES[place + 1 :] for step in fleet.did)
    assert rolled[place].problem
    assert not fleet.here[name].draining


async def test_it_goes_on_where_it_ended() -> None:
    """Given again, those that run the release already are left as they are."""
    fleet = FakeFleet()
    fleet.runs = {"root@g1": "1.1.0"}
    assert {each.state for each in await fleet.roll()} == {"upgraded"}
    assert not any("g1" in step for step in fleet.did)


async def test_nothing_is_touched_in_a_fleet_that_is_not_well() -> None:
    """A machine for each gateway and none besides; all there, none draining, all able to take runs."""
    fleet = FakeFleet()
    with pytest.raises(ConfigError, match="no machine is named for g3"):
        await fleet.roll({name: TARGETS[name] for name in NAMES[:2]})
    with pytest.raises(RefusedError, match="g4 does not answer"):
        await fleet.roll({**TARGETS, "g4": "root@g4"})
    for changes in ({"draining": True}, {"pool_problem": "Podman does not answer"}):
        fleet._now("g2", **changes)
        with pytest.raises(RefusedError, match="g2 cannot take runs"):
            await fleet.roll()
    assert fleet.did == []


async def test_it_ends_where_another_gateway_is_lost_meanwhile() -> None:
    """Its work would have nowhere to go."""
    fleet = FakeFleet()
    upgrade = fleet.upgrade

    async def lose(destination: str, path: str, *, older: bool) -> Ended:
        ended = await upgrade(destination, path, older=older)
        fleet.here.pop("g3", None)
        return ended

    fleet.upgrade = lose  # type: ignore[method-assign]
    rolled = await fleet.roll()
    assert [each.state for each in rolled] == ["upgraded", "failed", "not touched"]
    assert "g3 is gone" in rolled[1].problem


async def test_runs_that_do_not_leave_are_not_waited_for_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stop ends them, and they are repeated elsewhere."""
    monkeypatch.setattr(rolling, "DRAIN_S", 3.0)
    fleet = FakeFleet()
    fleet.rounds = 10**9
    assert {each.state for each in await fleet.roll()} == {"upgraded"}


@pytest.fixture
def ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Put programs in the place of ssh and scp; returns what writes them, and where they note their arguments."""

    def write(script: str) -> Path:
        noted = tmp_path / "noted"
        for name in ("ssh", "scp"):
            path = tmp_path / name
            path.write_text(f'#!/bin/sh\necho {name} "$@" >> {noted}\n{script}\n')
            path.chmod(path.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
        return noted

    return write


async def test_ssh_asks_no_questions_and_removes_the_copy(ssh: Callable[[str], Path]) -> None:
    """In batch mode; what the upgrade says of itself is taken from its output, also when it ends with 1."""
    noted = ssh(
        """[ "$(basename $0)" = scp ] || echo '{"release":"1.1","before":"1.0","problem":"no","later":1}'; exit 0"""
    )
    path = await Ssh().copy("root@g1", Path("b c"))
    assert path.startswith("/var/tmp/")
    ended = await Ssh().upgrade("root@g1", path, older=True)
    assert (ended.release, ended.problem) == ("1.1", "no")
    said = noted.read_text()
    assert said.count("BatchMode=yes") == 2
    ssh("""echo '[{"id":"1.0","current":false},{"id":"1.1","current":true,"made":1.0}]'""")
    assert await Ssh().running("root@g1") == "1.1"
    assert f"swiftbot upgrade {path} --json --older" in said
    assert f"rm -f {path}" in said


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("echo 'Permission denied' >&2; exit 255", "cannot be reached: Permission denied"),
        ("exit 127", "with status 127: it said nothing"),
        ("echo hello; exit 1", "does not say how its upgrade ended"),
        ("echo '{\"release\":1}'", "does not say how its upgrade ended"),
    ],
)
async def test_what_fails_over_ssh_is_told(ssh: Callable[[str], Path], script: str, why: str) -> None:
    """With the machine's name, its last words, and what to try."""
    ssh(script)
    with pytest.raises(UnreachableError, match=f"root@g1 .*{why}") as caught:
        await Ssh().upgrade("root@g1", "/var/tmp/x", older=False)
    assert caught.value.remedy
