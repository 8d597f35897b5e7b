"""Each check of `swiftbot doctor` against machines that lack one thing."""

# ruff: noqa: ARG002, D102 - fakes have the signatures and the docstrings of what they stand for

import shutil
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest

from appliance.config import GatewayConfig
from appliance.doctor import Check, FileFacts, local_checks, podman_checks, run_checks
from appliance.errors import PoolError, PrerequisiteError, UnreachableError
from appliance.identity.authority import Authority
from appliance.llm.settings import LlmConfig
from appliance.model.robot_api import MavlinkLink
from appliance.model.roles import Role
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.pool.engine import ContainerSpec, Engine, EngineFacts, Found, FoundImage
from appliance.pool.images import reference
from appliance.pool.settings import PoolConfig
from appliance.robots.settings import RobotsConfig
from appliance.skills.catalogue import load_catalogue

pytestmark = pytest.mark.anyio

PROGRAMS = ("podman", "newuidmap", "newgidmap", "mmdebstrap", "crun", "runc", "fuse-overlayfs")
FACTS = EngineFacts(
    version="4.3.1",
    cgroup_version="v2",
    controllers=frozenset({"cpu", "memory", "pids"}),
    runtime="crun",
    storage_driver="overlay",
    rootless=True,
)


class FakeMachine:
    """A machine on which all is well; tests take things away."""

    def __init__(self) -> None:
        self.python: tuple[int, ...] = (3, 11, 2)
        self.uid = 990
        self.user = "swiftbot"
        self.home = Path("/home/swiftbot")
        self.environ: Mapping[str, str] = {"XDG_RUNTIME_DIR": "/run/user/990"}
        self.encoding = "UTF-8"
        self.programs = {name: f"/usr/bin/{name}" for name in PROGRAMS}
        self.texts = {
            "/etc/subuid": "root:1:1\nswiftbot:100000:65536\n",
            "/etc/subgid": "990:100000:65536\n",
            "/home/swiftbot/.config/containers/storage.conf": '[storage]\ndriver = "overlay"\n',
        }
        self.files = {
            "/run/user/990": FileFacts(owner=990, mode=0o700, writable=True),
            "/dev/fuse": FileFacts(owner=0, mode=0o666, writable=True),
            "/usr/bin/newuidmap": FileFacts(owner=0, mode=0o4755, writable=False, privileged=True),
            "/usr/bin/newgidmap": FileFacts(owner=0, mode=0o755, writable=False, privileged=True),
        }
        self.free = 50_000.0
        self.taken: dict[int, str] = {}
        self.time = 1_800_000_000.0
        self.synchronised: bool | None = True

    def which(self, program: str) -> str | None:
        return self.programs.get(program)

    def read(self, path: Path) -> str | None:
        return self.texts.get(str(path))

    def stat(self, path: Path) -> FileFacts | None:
        return self.files.get(str(path))

    def free_mb(self, path: Path) -> float:
        return self.free

    def bind_problem(self, host: str, port: int, *, udp: bool) -> str:
        return "Address already in use" if port in self.taken else ""

    def listener(self, port: int, *, udp: bool) -> str:
        return self.taken.get(port, "")

    def now(self) -> float:
        return self.time

    def clock_synchronised(self) -> bool | None:
        return self.synchronised


class FakeEngine:
    """A Podman with all images; `refuses` makes one call fail."""

    def __init__(self, *, facts: EngineFacts = FACTS, images: bool = True, refuses: Exception | None = None) -> None:
        self._facts, self._images, self._refuses = facts, images, refuses
        self.calls: list[str] = []
        self.closed = False

    async def facts(self) -> EngineFacts:
        return self._facts

    async def create(self, spec: ContainerSpec) -> str:
        self.calls.append(f"create {spec.image} {spec.runtime}")
        return spec.name

    async def start(self, container: str) -> None:
        self.calls.append("start")
        if self._refuses is not None:
            raise self._refuses

    async def remove(self, container: str) -> None:
        self.calls.append("remove")

    async def logs(self, container: str) -> str:
        return ""

    async def containers(self, labels: Mapping[str, str]) -> list[Found]:
        return []

    async def images(self) -> list[FoundImage]:
        if not self._images:
            return []
        names = [reference(each, PoolConfig()) for each in load_catalogue().images.values()]
        return [FoundImage(id="1", tags=(name,), size_bytes=1, created="") for name in names]

    async def ensure_volume(self, name: str, labels: Mapping[str, str]) -> None:
        return

    def close(self) -> None:
        self.closed = True


async def no_session() -> Session:
    """Stand in for a Zenoh that cannot open a session."""
    raise UnreachableError("no loopback", remedy="ip link set lo up")


def failed(checks: list[Check] | tuple[Check, ...]) -> dict[str, Check]:
    """Return the checks that are not ok, by name."""
    return {each.name: each for each in checks if not each.ok}


def test_a_complete_machine_passes() -> None:
    """On a machine that has everything no check fails."""
    assert failed(local_checks(FakeMachine(), None)) == {}


@pytest.mark.parametrize(
    ("attribute", "value", "name", "words"),
    [
        ("python", (3, 10, 9), "python", "python3"),
        ("uid", 0, "user", "as_user.sh"),
        ("encoding", "ANSI_X3.4-1968", "locale", "LANG"),
        ("time", 0.0, "clock", "timedatectl"),
        ("synchronised", False, "clock", "timesyncd"),
        ("environ", {}, "XDG_RUNTIME_DIR", "enable-linger"),
        ("free", 10.0, "disk", "prune"),
    ],
)
def test_what_is_missing_is_named_with_its_remedy(attribute: str, value: object, name: str, words: str) -> None:
    """Each wrong fact of the machine fails the check of its name, whose remedy says what to do."""
    machine = FakeMachine()
    setattr(machine, attribute, value)
    found = failed(local_checks(machine, None))
    assert words in found[name].remedy


@pytest.mark.parametrize("program", ["podman", "newuidmap", "newgidmap", "mmdebstrap"])
def test_a_missing_program_names_its_package(program: str) -> None:
    """A program that is not installed fails with the package to install."""
    machine = FakeMachine()
    del machine.programs[program]
    found = failed(local_checks(machine, None))[program]
    assert "not installed" in found.detail
    assert "apt-get install" in found.remedy


def test_one_runtime_is_enough() -> None:
    """Either of crun and runc will do; neither fails."""
    machine = FakeMachine()
    del machine.programs["crun"]
    assert failed(local_checks(machine, None)) == {}
    del machine.programs["runc"]
    assert "runtime" in failed(local_checks(machine, None))


def test_id_mapper_without_privilege_fails() -> None:
    """A newuidmap that lost its setuid bit, as in a badly unpacked image, is reported."""
    machine = FakeMachine()
    machine.files["/usr/bin/newuidmap"] = FileFacts(owner=0, mode=0o755, writable=False)
    assert "setuid" in failed(local_checks(machine, None))["newuidmap"].detail


@pytest.mark.parametrize("text", ["", "other:100000:65536\n", "swiftbot:100000:1000\n", "swiftbot:broken\n"])
def test_too_few_subordinate_ids_fail(text: str) -> None:
    """No range, another user's, a short one and a malformed line all fail, with the command that adds one."""
    machine = FakeMachine()
    machine.texts["/etc/subuid"] = text
    assert "usermod --add-subuids" in failed(local_checks(machine, None))["subuid"].remedy


@pytest.mark.parametrize(
    "facts",
    [
        None,
        FileFacts(owner=0, mode=0o700, writable=False),
        FileFacts(owner=990, mode=0o755, writable=True),
    ],
)
def test_runtime_folder_must_be_the_users_own(facts: FileFacts | None) -> None:
    """A runtime folder that is absent, somebody else's or open to others fails."""
    machine = FakeMachine()
    machine.files.pop("/run/user/990")
    if facts is not None:
        machine.files["/run/user/990"] = facts
    assert "XDG_RUNTIME_DIR" in failed(local_checks(machine, None))


def test_fuse_is_asked_for_only_where_it_is_used() -> None:
    """fuse-overlayfs and /dev/fuse matter when storage.conf names them, and only then."""
    machine = FakeMachine()
    del machine.programs["fuse-overlayfs"]
    assert failed(local_checks(machine, None)) == {}
    machine.texts["/home/swiftbot/.config/containers/storage.conf"] = 'mount_program = "/usr/bin/fuse-overlayfs"\n'
    assert failed(local_checks(machine, None))["fuse-overlayfs"].remedy == "apt-get install fuse-overlayfs"
    machine.programs["fuse-overlayfs"] = "/usr/bin/fuse-overlayfs"
    machine.files.pop("/dev/fuse")
    assert "/dev/fuse" in failed(local_checks(machine, None))["fuse-overlayfs"].detail


def test_ports_of_the_configuration_are_tried() -> None:
    """A port held by somebody else fails; one held by the running gateway is as it should be."""
    config = GatewayConfig(
        id="gw-1",
        plane=PlaneConfig(listen=("tcp/0.0.0.0:7447",)),
        robots=RobotsConfig(mavlink=(MavlinkLink(listen="udp://127.0.0.1:14550"),)),
        llm=LlmConfig(local_model=""),
    )
    machine = FakeMachine()
    assert failed(local_checks(machine, config)) == {}
    machine.taken = {7447: "python swiftbot gateway --config x", 14550: "nc -ul 14550"}
    found = failed(local_checks(machine, config))
    assert list(found) == ["port 14550"]
    assert "nc -ul" in found["port 14550"].detail
    assert "ss -lunp" in found["port 14550"].remedy


def test_a_model_is_optional_but_must_be_one() -> None:
    """No model is fine; a configured folder without one is noted and keeps nothing down."""
    config = msgspec.convert({"id": "gw-1", "llm": {"local_model": "/models/none"}}, GatewayConfig)
    found = failed(local_checks(FakeMachine(), config))["model"]
    assert not found.required


def test_limits_that_do_not_hold_are_a_note() -> None:
    """Cgroup v1, or v2 without delegation, is a limit to know about and not a failure."""
    for facts in (
        msgspec.structs.replace(FACTS, cgroup_version="v1", controllers=frozenset[str]()),
        msgspec.structs.replace(FACTS, controllers=frozenset({"memory", "pids"})),
    ):
        found = failed(tuple(podman_checks(facts)))
        assert list(found) == ["limits"]
        assert not found["limits"].required


def test_slow_storage_fails() -> None:
    """The vfs driver, which copies whole images, is not accepted."""
    found = failed(tuple(podman_checks(msgspec.structs.replace(FACTS, storage_driver="vfs"))))
    assert "overlay" in found["storage"].remedy


async def checks_with(engine: FakeEngine) -> tuple[Check, ...]:
    """Run all checks with this engine and no Zenoh."""

    def make() -> Engine:
        return engine

    return await run_checks(machine=FakeMachine(), make_engine=make, open_session=no_session)


async def test_podman_is_tried_with_a_container() -> None:
    """With images there, one container is made, started and removed, and Podman is let go of."""
    engine = FakeEngine()
    found = failed(await checks_with(engine))
    assert list(found) == ["zenoh"]
    assert found["zenoh"].remedy == "ip link set lo up"
    assert [call.split()[0] for call in engine.calls] == ["create", "start", "remove"]
    assert engine.closed


async def test_cgroup_v1_is_tried_with_runc() -> None:
    """On cgroup v1 the container asks for runc, as the pool does."""
    engine = FakeEngine(facts=msgspec.structs.replace(FACTS, cgroup_version="v1"))
    await checks_with(engine)
    assert engine.calls[0].endswith(" runc")


async def test_a_container_that_does_not_start_is_told_and_removed() -> None:
    """What the OCI runtime said is the detail, and nothing is left behind."""
    engine = FakeEngine(refuses=PoolError("start: crun: cgroups in hybrid mode not supported"))
    found = failed(await checks_with(engine))["container"]
    assert "hybrid" in found.detail
    assert "runc" in found.remedy
    assert engine.calls[-1] == "remove"


async def test_missing_images_name_the_command() -> None:
    """Each image that is not built fails with the command that builds it."""
    found = failed(await checks_with(FakeEngine(images=False)))
    for name, spec in load_catalogue().images.items():
        assert found[f"image {name}"].remedy == f"swiftbot images build{' learn' if spec.on_demand else ''}"
        assert found[f"image {name}"].required != spec.on_demand


@pytest.mark.parametrize("error", [UnreachableError("socket is not there"), PrerequisiteError("no XDG_RUNTIME_DIR")])
async def test_without_podman_nothing_is_passed_over(error: Exception) -> None:
    """Where Podman does not answer, what only it could tell is shown as unknown."""

    def make() -> Engine:
        raise error

    found = failed(await run_checks(machine=FakeMachine(), make_engine=make, open_session=no_session))
    assert {"podman api", "storage", "images", "container"} <= set(found)
    assert all(each.remedy for each in found.values())


def test_keys_are_looked_at(tmp_path: Path) -> None:
    """None are needed within one machine; those that are there must be this gateway's, and not about to expire."""
    now = datetime.now(UTC)
    authority = Authority.create(tmp_path / "authority", "default", now)
    keys = tmp_path / "gw-1.pem"
    authority.issue(Role.GATEWAY, "gw-1", out=keys, days=10, now=now)
    shutil.copy(authority.roster_file, tmp_path / "roster.json")
    plane = PlaneConfig(listen=("tls/127.0.0.1:7447",), keys=str(keys))
    machine = FakeMachine()

    def found(gateway: str, at: datetime, plane: PlaneConfig = plane) -> Check | None:
        machine.time = at.timestamp()
        config = GatewayConfig(id=gateway, plane=plane, llm=LlmConfig(local_model=""))
        return failed(local_checks(machine, config)).get("keys")

    assert found("gw-1", now, PlaneConfig()) is None
    expiring = found("gw-1", now)
    assert expiring is not None
    assert ("expires in 10 days" in expiring.detail, expiring.required) == (True, False)
    assert "swiftbot keys renew gateway gw-1" in expiring.remedy
    other = found("gw-2", now)
    assert other is not None
    assert other.required
    late = found("gw-1", now + timedelta(days=11))
    assert late is not None
    assert "expired" in late.detail
    authority.renew(Role.GATEWAY, "gw-1", out=keys)
    shutil.copy(authority.roster_file, tmp_path / "roster.json")
    assert found("gw-1", now) is None
