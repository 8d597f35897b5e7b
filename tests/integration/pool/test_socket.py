"""The pool when Podman's API socket dies under it and comes back: real Podman, a socket of the test's own."""

import asyncio
import contextlib
import secrets
import tempfile
from collections.abc import AsyncIterator, Collection
from pathlib import Path
from typing import Any

import pytest

from appliance.model import ContainerState, Need, RunEventKind, RunRequest, Site
from appliance.pool import images
from appliance.pool.engine import remove_fleet
from appliance.pool.pool import Call, Pool
from appliance.pool.selection import Candidate
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import Catalogue, load_catalogue

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]


class Service:
    """`podman system service` on a socket of its own, to be killed and started again."""

    def __init__(self, socket: Path) -> None:
        self.socket = socket
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Start it and wait until it listens."""
        self.socket.unlink(missing_ok=True)
        self._process = await asyncio.create_subprocess_exec(
            "podman", "system", "service", "--time=0", f"unix://{self.socket}"
        )
        async with asyncio.timeout(20):
            while not self.socket.is_socket():
                assert self._process.returncode is None, "podman system service ended"
                await asyncio.sleep(0.05)

    async def kill(self) -> None:
        """Kill it; the socket file stays behind, as after a crash."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
            await self._process.wait()
            self._process = None


@pytest.fixture
async def service() -> AsyncIterator[Service]:
    """A running API service."""
    with tempfile.TemporaryDirectory(prefix="sb-") as folder:
        found = Service(Path(folder) / "p.sock")
        await found.start()
        yield found
        await found.kill()


@pytest.fixture
def catalogue(tmp_path: Path) -> Catalogue:
    """The catalogue with a skill that does nothing."""
    skill = tmp_path / "skills" / "nothing"
    skill.mkdir(parents=True)
    (skill / "handler.py").write_text("def run(ctx):\n    return {}\n")
    (skill / "skill.toml").write_text(
        'id = "nothing"\ndomain = "coordination"\nsummary = "A test."\nruns = "compute"\nimage = "base"\n'
        "cpu = 0.2\nmemory_mb = 64\n"
    )
    return load_catalogue([skill.parent])


async def test_warm_containers_serve_on_while_podman_is_away(
    service: Service, catalogue: Catalogue, tmp_path: Path
) -> None:
    """A dead API socket is reported with its remedy, runs in warm containers go on, and a new socket is taken up."""

    async def nobody(need: Need, avoid: Collection[str]) -> list[Candidate]:
        return []

    async def nothing(call: Call) -> dict[str, Any]:
        return {}

    await images.build("base", catalogue)
    fleet = f"test-{secrets.token_hex(4)}"
    pool = Pool(
        PoolConfig(podman_url=f"unix://{service.socket}", floor={"base": 2}, mode="local", reconnect_s=0.2, max_runs=3),
        gateway="g1",
        fleet=fleet,
        run_dir=tmp_path / "run",
        data_dir=tmp_path / "data",
        catalogue=catalogue,
        site=Site(),
        find_remote=nobody,
        on_call=nothing,
        on_change=lambda _: None,
    )

    def ready() -> int:
        return sum(each.state is ContainerState.READY for each in pool.containers())

    async def run(number: int) -> RunEventKind:
        need = Need(image="base", cpu=0.2, memory_mb=64)
        request = RunRequest(task="t", subtask=f"s{number}", attempt=1, skill="nothing", need=need)
        decision = await pool.select(need, allow_remote=False)
        return (await pool.run(request, decision, lambda _: None)).kind

    await pool.start()
    try:
        async with asyncio.timeout(60):
            while ready() < 2:
                await asyncio.sleep(0.02)
        await service.kill()
        assert await run(0) is RunEventKind.SUCCEEDED
        # Containers are replaced after three runs, which takes the API: now the pool has to notice.
        for number in range(1, 6):
            if ready():
                assert await run(number) is RunEventKind.SUCCEEDED
        async with asyncio.timeout(60):
            while not pool.problem:
                await asyncio.sleep(0.05)
        assert "odman" in pool.problem
        await service.start()
        async with asyncio.timeout(60):
            while pool.problem or ready() < 2:
                await asyncio.sleep(0.05)
        assert await run(9) is RunEventKind.SUCCEEDED
    finally:
        await pool.stop(keep_containers=False)
        await remove_fleet(fleet, volumes=True)
