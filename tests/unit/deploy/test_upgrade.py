"""Upgrades: what works stays, what does not is undone, and a power cut at any moment leaves one or the other."""

import errno
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance import durable
from appliance.cli import releases
from appliance.deploy.host import Machine
from appliance.deploy.layout import Layout
from appliance.deploy.upgrade import ENDS, Journal, Step, Upgrade, after, resumed
from appliance.errors import ConfigError, ConflictError, IdentityError, NotFoundError, RefusedError

pytestmark = pytest.mark.anyio
SERVICES = ("swiftbot-gateway.service", "swiftbot-recorder.service")


class PowerCutError(BaseException):
    """The power goes: nothing catches it."""


class FakeHost:
    """Services that run the release that was current when they were started."""

    def __init__(self, layout: Layout, *, broken: Mapping[str, str], cut: Callable[[], None] = lambda: None) -> None:
        self._layout = layout
        self.broken = broken
        """By version: what does not work of it: start, stays or doctor."""
        self._cut = cut
        self.up: dict[str, str] = {}
        self.pid = 100
        self.done: list[str] = []

    def boot(self) -> None:
        """As after a power cut: enabled services start, with what is current."""
        self.up = dict.fromkeys(SERVICES, self._version())

    def _version(self) -> str:
        return self._layout.running().partition("+")[0]

    def _breaks(self, how: str) -> bool:
        return self.broken.get(self._version()) in (how, "all")

    async def running(self) -> tuple[str, ...]:
        """All that are up."""
        return tuple(self.up)

    async def stop(self, services: Sequence[str]) -> None:
        """Take them down."""
        self._cut()
        self.done.append("stop")
        for each in services:
            self.up.pop(each, None)

    async def start(self, services: Sequence[str]) -> None:
        """Bring them up with what is current."""
        self._cut()
        self.done.append("start")
        if self._breaks("start"):
            raise RefusedError("swiftbot-gateway.service ended with 1")
        self.up |= dict.fromkeys(services, self._version())

    async def reload(self) -> None:
        """Nothing to read."""
        self._cut()
        self.done.append("reload")

    async def processes(self, services: Sequence[str]) -> Mapping[str, int]:
        """Another one each time for a release that does not stay up."""
        if self._breaks("stays"):
            self.pid += 1
        return {each: self.pid for each in services if each in self.up}

    async def settle(self) -> None:
        """No time passes."""
        self._cut()

    async def wrong(self, program: Path) -> Mapping[str, str]:
        """Something that was wrong all the time, and what this release breaks."""
        assert program.name == "swiftbot"
        always = {"ports": "taken"}
        return always | ({"podman api": "it is gone"} if self._breaks("doctor") else {})


def add_release(layout: Layout, version: str) -> str:
    """Lay a small release out."""
    staged = layout.stage(f"{version}+abc")
    (staged / "systemd").mkdir()
    (staged / "systemd/swiftbot-gateway.service").write_text(version)
    return layout.finish(staged, f"{version}+abc", version)


@pytest.fixture
def machine(tmp_path: Path) -> Layout:
    """A machine that was upgraded from 1 to 2, and has 3 beside them."""
    layout = Layout(tmp_path)
    for version in ("1", "2"):
        layout.switch(add_release(layout, version))
    add_release(layout, "3")
    return layout


def test_a_root_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    """What is a file and no folder holds no releases; nothing has begun."""
    (tmp_path / "file").write_text("")
    layout = Layout(tmp_path / "file")
    upgrade = Upgrade(layout, FakeHost(layout, broken={}), say=lambda _: None)
    with pytest.raises(ConfigError, match="cannot be written") as caught, upgrade.alone():
        pytest.fail("it has begun")
    assert "--root" in caught.value.remedy


async def test_a_mistyped_root_gets_no_folders(tmp_path: Path) -> None:
    """Rollback, resume and upgrade name what is missing below --root, and make nothing there."""
    root = tmp_path / "typo"
    for done in (releases.rollback(root=root), releases.upgrade(resume=True, root=root)):
        with pytest.raises(NotFoundError, match="no installation") as caught:
            await done
        assert "--root" in caught.value.remedy
    with pytest.raises(IdentityError, match=r"release\.pub"):
        await releases.upgrade(tmp_path / "any.bundle", root=root)
    assert not root.exists()


def test_another_installation_leaves_the_services_of_this_machine_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """With --root nothing is stopped or started here, also where systemd runs; without it, it is."""
    monkeypatch.setattr(Path, "is_dir", Path.is_absolute)
    assert Machine().systemd
    assert not Machine(services=False).systemd


async def test_an_upgrade_below_another_root_asks_for_no_services(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command line gives a machine without services for every root but this machine's own."""
    asked: list[bool] = []

    class Seen(Machine):
        def __init__(self, *, config: Path, services: bool) -> None:
            asked.append(services)
            super().__init__(config=config, services=services)

    monkeypatch.setattr("appliance.deploy.host.Machine", Seen)
    monkeypatch.setattr("os.getuid", lambda: 0)
    with pytest.raises(NotFoundError):
        await releases.rollback(root=tmp_path / "other")
    with pytest.raises((IdentityError, ConfigError)):  # no key here, or no such bundle
        await releases.upgrade(tmp_path / "any.bundle", root=Path("/etc/.."))
    assert asked == [False, True]


def make(layout: Layout, host: FakeHost) -> Upgrade:
    """An upgrade, with a machine whose services run."""
    if not host.up:
        host.boot()
    return Upgrade(layout, host, say=lambda _: None)


async def test_a_release_that_works_stays(machine: Layout) -> None:
    """Stopped, switched while nothing runs, started, checked; the one before is what rollback goes to."""
    host = FakeHost(machine, broken={})
    ended = await make(machine, host).to("3+abc")
    assert (ended.release, ended.before, ended.problem) == ("3+abc", "2+abc", "")
    assert host.done == ["stop", "reload", "start"]
    assert set(host.up.values()) == {"3"}


@pytest.mark.parametrize(
    ("how", "said"),
    [("start", "ended with 1"), ("stays", "did not stay up"), ("doctor", "podman api: it is gone")],
)
async def test_one_that_does_not_is_undone(machine: Layout, how: str, said: str) -> None:
    """The release before is current and runs again, and rollback goes where it would have gone before."""
    host = FakeHost(machine, broken={"3": how})
    upgrading = make(machine, host)
    ended = await upgrading.to("3+abc")
    assert (ended.release, ended.before, ended.rolled_back, ended.problem_back) == ("2+abc", "1+abc", True, "")
    assert said in ended.problem
    assert set(host.up.values()) == {"2"}
    assert upgrading.interrupted() is None


async def test_what_was_wrong_before_ends_no_upgrade(machine: Layout) -> None:
    """An upgrade may be the remedy: doctor's findings of the release before do not count."""
    host = FakeHost(machine, broken={"2": "doctor", "3": "doctor"})
    assert (await make(machine, host).to("3+abc")).release == "3+abc"


async def test_rollback_goes_back_and_says_when_that_does_not_work(machine: Layout) -> None:
    """The release before becomes current, also when it turns out not to work: nothing is switched to and fro."""
    host = FakeHost(machine, broken={})
    ended = await make(machine, host).rollback()
    assert (ended.release, ended.before) == ("1+abc", "2+abc")
    host = FakeHost(machine, broken={"2": "start"})
    ended = await make(machine, host).rollback()
    assert (ended.release, ended.rolled_back) == ("2+abc", False)
    assert "ended with 1" in ended.problem


async def test_both_broken_is_said(machine: Layout) -> None:
    """Where the release before does not come up either, both reasons are given, and it is current."""
    host = FakeHost(machine, broken={"2": "start", "3": "start"})
    ended = await make(machine, host).to("3+abc")
    assert ended.release == "2+abc"
    assert ended.problem
    assert ended.problem_back


@pytest.mark.parametrize("room", range(5))
async def test_a_full_disk_leaves_no_service_down(machine: Layout, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    """Wherever the journal cannot be written any more, the release that ran runs again; before a stop nothing is."""
    host = FakeHost(machine, broken={})
    upgrading = make(machine, host)
    real, left = durable.write, room

    def write(path: Path, data: bytes, *, mode: int) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        real(path, data, mode=mode)

    monkeypatch.setattr(durable, "write", write)
    if room == 0:
        with pytest.raises(RefusedError, match="nothing was stopped"):
            await upgrading.to("3+abc")
        assert host.done == []
    else:
        ended = await upgrading.to("3+abc")
        assert (ended.release, ended.rolled_back, ended.problem_back) == ("2+abc", True, "")
        assert "No space left" in ended.problem
    assert host.up == dict.fromkeys(SERVICES, "2")


async def test_a_rollback_that_cannot_stop_starts_what_it_stopped(machine: Layout) -> None:
    """One service does not stop in time: those that did run again, and it says why."""

    class Stubborn(FakeHost):
        async def stop(self, services: Sequence[str]) -> None:
            """The first is down, the second stays."""
            del self.up[services[0]]
            raise RefusedError("systemctl stop did not end within 120 s")

    host = Stubborn(machine, broken={})
    ended = await make(machine, host).rollback()
    assert (ended.release, ended.rolled_back) == ("2+abc", True)
    assert "did not end" in ended.problem
    assert host.up == dict.fromkeys(SERVICES, "2")


async def test_mistakes_are_refused(machine: Layout, tmp_path: Path) -> None:
    """The release that runs, none to go back to, a second upgrade at the same time."""
    upgrading = make(machine, FakeHost(machine, broken={}))
    with pytest.raises(RefusedError, match="runs already"):
        await upgrading.to("2+abc")
    with upgrading.alone(), pytest.raises(ConflictError, match="another upgrade"), upgrading.alone():
        pass
    empty = Layout(tmp_path / "empty")
    with pytest.raises(NotFoundError, match="no release to go back to"):
        await make(empty, FakeHost(empty, broken={})).rollback()


@pytest.mark.parametrize("how", ["", "start", "stays", "doctor", "all"])
async def test_power_cut_at_any_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    """Before every write and every act on a service: the next boot finishes the upgrade, or undoes it, whole."""

    def unsynced(_: object) -> None:
        """Nothing waits for a disk: the power goes in this process alone."""

    monkeypatch.setattr(durable.os, "fsync", unsynced)
    left = 0

    def cut() -> None:
        nonlocal left
        left -= 1
        if left == 0:
            raise PowerCutError

    for name in ("write", "link", "rename", "remove"):
        real = getattr(durable, name)

        def counted(*arguments: object, real: Callable[..., None] = real, **options: object) -> None:
            cut()
            real(*arguments, **options)

        monkeypatch.setattr(durable, name, counted)
    number, seen = 0, set[str]()
    while True:
        number += 1
        layout = Layout(tmp_path / str(number))
        left = 0
        for version in ("1", "2"):
            layout.switch(add_release(layout, version))
        add_release(layout, "3")
        host = FakeHost(layout, broken={"3": how}, cut=cut)
        upgrading = make(layout, host)
        left = number
        try:
            await upgrading.to("3+abc")
        except PowerCutError:
            pass
        else:
            break
        left = 0
        assert layout.running() in ("2+abc", "3+abc")
        host.boot()
        again = make(layout, host)
        if again.interrupted() is None:
            assert layout.running() in (("2+abc", "3+abc") if not how else ("2+abc",))
        else:
            with pytest.raises(ConflictError, match="--resume finishes it"):
                await again.to("1+abc")
            ended = await again.resume()
            assert ended is not None
            assert ended.release == ("2+abc" if how else "3+abc")
            assert ended.before == ("1+abc" if how else "2+abc")
        assert set(host.up.values()) == {layout.running()[0]}
        assert again.interrupted() is None
        seen.add(layout.running())
    assert number > 8
    assert seen == ({"2+abc"} if how else {"2+abc", "3+abc"})


async def test_an_interrupted_upgrade_can_be_turned_round(machine: Layout) -> None:
    """`swiftbot rollback` after a cut goes back to the release that ran, wherever the upgrade was."""
    host = FakeHost(machine, broken={})
    upgrading = make(machine, host)
    for step in set(Step) - ENDS:
        machine.switch("3+abc")
        journal = Journal(source="2+abc", target="3+abc", before="1+abc", step=step, services=SERVICES)
        upgrading._written(journal)  # pyright: ignore[reportPrivateUsage] - as a cut leaves it
        ended = await upgrading.rollback()
        assert (ended.release, ended.before, set(host.up.values())) == ("2+abc", "1+abc", {"2"})


@given(st.lists(st.booleans(), min_size=20, max_size=20), st.booleans(), st.booleans(), st.data())
def test_every_way_ends(failures: list[bool], back: bool, first: bool, data: st.DataObject) -> None:
    """Whatever fails, and wherever power goes, it ends within 14 steps: done only if no step of it failed."""
    journal = Journal(source="" if first else "2", target="3", back=back)
    failed = 0
    for steps, fails in enumerate(failures):
        if journal.step in ENDS:
            break
        assert steps < 14
        if data.draw(st.booleans()) and steps < 3:
            journal = resumed(journal)
        failed += fails
        journal = after(journal, "broken" if fails else "")
    assert journal.step in ENDS
    assert (journal.step is Step.DONE) == (failed == 0)
    assert bool(journal.problem) == (failed > 0)
