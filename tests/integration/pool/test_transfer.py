"""Volumes and images between gateways: real sessions, real Podman; broken, killed, lied to, without room."""

import asyncio
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from transfer_bench import MIB, Side, Sides, fill, moved, podman_service, same, sides, small_image, tree

from appliance.errors import CancelledByOperatorError, NotFoundError, PayloadError, RefusedError, SwiftbotError
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.pool.engine import PodmanEngine
from appliance.pool.selection import mig_cost_ms
from appliance.pool.volumes.archive import Digests
from appliance.pool.volumes.source import Offer
from appliance.pool.volumes.store import LABEL_KEPT, podman_name

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]


@pytest.fixture
async def fleet(podman: Path, folder: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Sides]:
    """Gateways of the test's own, none started yet."""
    async with sides(folder, free_ports(3)) as made:
        yield made


@pytest.fixture
async def pair(fleet: Sides) -> tuple[Side, Side]:
    """Two gateways that see each other."""
    one, other = await fleet.start(0), await fleet.start(1)
    await fleet.settled()
    return one, other


async def test_64_mib_there_and_what_changed_back(
    pair: tuple[Side, Side], record_property: Callable[[str, object], None]
) -> None:
    """A volume of 64 MiB arrives whole, known there as newest; back comes only what a run changed there."""
    one, other = pair
    await one.change("maps", fill(64))
    brought = await other.transfers.bring_volume("maps")
    assert await same(one, other, "maps")
    assert brought.gateway == "g0"
    assert brought.size_bytes > 64 * MIB
    assert brought.wire_bytes < 0.6 * brought.size_bytes, "half of it compresses to nothing"
    assert other.volumes.newest_here("maps")
    assert other.volumes.infos()[0].generation == 1
    assert other.transfers.link("g0").bytes_per_s
    assert 0 < mig_cost_ms([(64 * MIB, other.transfers.link("g0"))]) < 60_000
    record_property("duration_ms", brought.duration_ms)

    assert (await other.transfers.bring_volume("maps")).wire_bytes == 0
    await other.change("maps", lambda folder: (folder / "note").write_text("seen"))
    back = await one.transfers.bring_volume("maps", "g1")
    assert await same(one, other, "maps")
    assert back.wire_bytes < 4 * MIB
    assert back.resumed_bytes > 60 * MIB
    for side in pair:
        assert not side.transfers.refused
        assert not side.volumes.refused
        assert not side.transfers.active()


async def test_what_a_container_wrote_as_its_root_moves(built: None, pair: tuple[Side, Side]) -> None:
    """Files made in a container by its root without capabilities, some closed to all, arrive with their modes."""
    one, other = pair
    name = podman_name(one.fleet, "g0", "state")
    folder = await one.folder("state")
    code = """
        import os
        os.umask(0o077)
        os.makedirs("/volumes/state/deep/er")
        open("/volumes/state/deep/er/f", "w").write("made inside")
        open("/volumes/state/closed", "w").write("nobody reads this")
        os.chmod("/volumes/state/closed", 0)
        os.chmod("/volumes/state/deep/er", 0o500)
        os.symlink("deep/er/f", "/volumes/state/link")
    """
    image = next(tag for each in await one.storage.images() for tag in each.tags if "swiftbot/base" in tag)
    command = ["podman", "run", "--rm", "--cap-drop=all", "--user=0:0", "--network=none", "--read-only"]
    if (await one.storage.facts()).cgroup_version == "v1":
        command[1:1] = ["--runtime", "runc"]
    command += ["--volume", f"{name}:/volumes/state", image, "python3", "-c", textwrap.dedent(code)]
    async with one.volumes.use(["state"]):
        done = await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (folder / "closed").stat().st_uid == os.getuid()
    await other.transfers.bring_volume("state")
    there = await other.folder("state")
    assert (there / "deep" / "er" / "f").read_text() == "made inside"
    assert (there / "closed").stat().st_mode & 0o777 == 0
    assert (there / "link").readlink() == Path("deep/er/f")
    (there / "closed").chmod(0o400)
    assert (there / "closed").read_text() == "nobody reads this"


async def test_broken_in_the_middle_and_gone_on(fleet: Sides) -> None:
    """The receiver stops in mid-transfer and starts again: only the rest comes; the old state stayed whole."""
    one, other = await fleet.start(0), await fleet.start(1, window=1)
    await fleet.settled()
    await one.change("maps", fill(16))
    await other.transfers.bring_volume("maps")
    before = await asyncio.to_thread(tree, await other.folder("maps"))
    await one.change("maps", fill(16))
    bringing = asyncio.create_task(other.transfers.bring_volume("maps"))
    await moved(other, 4 * MIB)
    await fleet.stop(1)
    with pytest.raises((asyncio.CancelledError, SwiftbotError)):
        await bringing
    other = await fleet.start(1)
    await fleet.settled()
    assert await asyncio.to_thread(tree, await other.folder("maps")) == before
    brought = await other.transfers.bring_volume("maps")
    assert brought.resumed_bytes >= 4 * MIB
    assert await same(one, other, "maps")


async def test_cancelled_and_gone_on(fleet: Sides) -> None:
    """A transfer that is cancelled says so, to its caller and on its key; the next try goes on where it was."""
    one, other = await fleet.start(0), await fleet.start(1, window=1)
    await fleet.settled()
    await one.change("maps", fill(16))
    seen: list[bytes] = []
    one.plane.session.subscribe(
        Keys(fleet.fleet)(keyspace.TRANSFER, "g1"), lambda message: seen.append(message.payload)
    )
    bringing = asyncio.create_task(other.transfers.bring_volume("maps"))
    await moved(other, 4 * MIB)
    assert not other.transfers.cancel("nothing")
    assert other.transfers.cancel(other.transfers.active()[0].id)
    with pytest.raises(CancelledByOperatorError):
        await bringing
    async with asyncio.timeout(30):
        while not any(b'"cancelled"' in each for each in seen):
            await asyncio.sleep(0.01)
    assert (await other.transfers.bring_volume("maps")).resumed_bytes >= 4 * MIB
    assert await same(one, other, "maps")


GATEWAY = """
import asyncio, os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from transfer_bench import open_side

async def main():
    folder, fleet, listen, connect = sys.argv[2:]
    side = await open_side(Path(folder), fleet=fleet, gateway="g2", listen=listen, connect=tuple(connect.split(",")))
    if "maps" not in {each.name for each in side.volumes.infos()}:
        await side.change("maps", lambda where: (where / "weights").write_bytes(os.urandom(24 * 2**20)))
    print("ready", flush=True)
    await asyncio.sleep(300)

asyncio.run(main())
"""


async def test_the_giving_gateway_is_killed_in_the_middle(fleet: Sides) -> None:
    """SIGKILL of the source in mid-transfer: an error, nothing changed here; after its restart the rest comes."""
    here = await fleet.start(0, window=1, patience_s=1.0)
    others = (fleet.endpoints[0], fleet.endpoints[1])

    async def source() -> asyncio.subprocess.Process:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-c",
            GATEWAY,
            str(Path(__file__).parents[1]),
            str(fleet.folder / "g2"),
            fleet.fleet,
            fleet.endpoints[2],
            ",".join(others),
            stdout=asyncio.subprocess.PIPE,
        )
        assert process.stdout is not None
        async with asyncio.timeout(60):
            while await process.stdout.readline() != b"ready\n":
                assert process.returncode is None
        return process

    process = await source()
    try:
        await fleet.settled(2)
        bringing = asyncio.create_task(here.transfers.bring_volume("maps"))
        await moved(here, 4 * MIB)
        process.send_signal(signal.SIGKILL)
        with pytest.raises(SwiftbotError):
            await bringing
        assert await asyncio.to_thread(tree, await here.folder("maps")) == {}
        assert here.volumes.state("maps").version == {}
        await process.wait()
        process = await source()
        await fleet.settled(2)
        brought = await here.transfers.bring_volume("maps")
        assert brought.resumed_bytes >= 4 * MIB
        data = await asyncio.to_thread(((await here.folder("maps")) / "weights").read_bytes)
        assert len(data) == 24 * MIB
    finally:
        process.kill()
        await process.wait()


async def test_another_gateway_goes_on_where_the_first_broke(fleet: Sides) -> None:
    """The first source stops in mid-transfer; another that holds the same state gives the rest within the same call."""
    one, two = await fleet.start(0), await fleet.start(1)
    await fleet.settled()
    await one.change("maps", fill(16))
    await two.transfers.bring_volume("maps")
    three = await fleet.start(2, window=1)
    await fleet.settled()
    three.volumes.hear("g1", two.volumes.infos())
    bringing = asyncio.create_task(three.transfers.bring_volume("maps", "g0"))
    await moved(three, 3 * MIB)
    await fleet.stop(0)
    brought = await bringing
    assert brought.gateway == "g1"
    assert await same(two, three, "maps")


async def test_corrupted_chunks_are_counted_and_never_applied(
    pair: tuple[Side, Side], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A source whose chunks are damaged on the way is refused and counted; the old state stays; then all is well."""
    one, other = pair
    await one.change("maps", fill(4))
    await other.transfers.bring_volume("maps")
    before = await asyncio.to_thread(tree, await other.folder("maps"))
    await one.change("maps", fill(4))
    real = Offer.chunk

    def damaged(self: Offer, index: int, *, zstd: bool) -> bytes:
        answer = bytearray(real(self, index, zstd=zstd))
        answer[-1] ^= 0x40
        return bytes(answer)

    monkeypatch.setattr(Offer, "chunk", damaged)
    with pytest.raises(PayloadError):
        await other.transfers.bring_volume("maps")
    assert other.transfers.refused["transfer bad chunk"] == 3
    assert await asyncio.to_thread(tree, await other.folder("maps")) == before
    monkeypatch.undo()
    await other.transfers.bring_volume("maps")
    assert await same(one, other, "maps")


FULL = """
import asyncio, os, subprocess, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from transfer_bench import open_side
from appliance.errors import RefusedError
from appliance.pool.volumes.target import Spool

async def main():
    folder, fleet, listen, connect = sys.argv[2:]
    small = Path(folder) / "transfer"
    small.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(small)], check=True)
    side = await open_side(Path(folder), fleet=fleet, gateway="g2", listen=listen, connect=(connect,))
    # What is asked for first is believed to fit: the disk itself must say that it does not.
    Spool.make_room = lambda self, size: None
    async with asyncio.timeout(60):
        while len(side.plane.members()) < 2 or not side.plane.dht.settling.reconciled():
            await asyncio.sleep(0.01)
    try:
        await side.transfers.bring_volume("maps")
    except RefusedError as error:
        print("refused:", error.message, "| remedy:", error.remedy)
    left = sorted(str(each.relative_to(small)) for each in small.rglob("*"))
    print("left:", left, "free:", os.statvfs(small).f_bavail * os.statvfs(small).f_frsize > 7 * 2**20)
    await side.stop()

asyncio.run(main())
"""


async def test_a_real_disk_that_is_full(fleet: Sides) -> None:
    """On a file system of 8 MiB a volume of 16 is refused with a remedy, and nothing of it is left there."""
    one = await fleet.start(0)
    await one.change("maps", fill(16))
    # In a user namespace the service user may mount a tmpfs of its own.
    command = [
        "podman",
        "unshare",
        sys.executable,
        "-c",
        FULL,
        str(Path(__file__).parents[1]),
        str(fleet.folder / "g2"),
    ]
    command += [fleet.fleet, fleet.endpoints[2], fleet.endpoints[0]]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(each for each in sys.path if each)}
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT, env=environment
    )
    output = (await process.communicate())[0].decode()
    assert "refused: volume maps could not be written: there is no more room" in output, output
    assert "remedy: free space" in output
    assert "left: ['arriving', 'offered'] free: True" in output, output


async def test_no_room_to_unpack(pair: tuple[Side, Side], monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fills while the state is unpacked: the old one stays whole, nothing is left beside it."""
    one, other = pair
    await one.change("maps", fill(4))
    await other.change("maps", lambda folder: (folder / "own").write_text("mine"))
    for _ in range(2):
        await one.change("maps", fill(4))
    folder = await other.folder("maps")
    real, calls = os.fchmod, 0

    def full(descriptor: int, mode: int) -> None:
        nonlocal calls
        calls += 1
        if calls == 20:
            raise OSError(28, "No space left on device")
        real(descriptor, mode)

    monkeypatch.setattr(os, "fchmod", full)
    with pytest.raises(RefusedError, match="no more room"):
        await other.transfers.bring_volume("maps")
    monkeypatch.undo()
    assert await asyncio.to_thread(tree, folder) == {"own": tree(folder)["own"]}
    assert [each.name for each in folder.parent.iterdir()] == ["_data"]
    brought = await other.transfers.bring_volume("maps")
    assert brought.wire_bytes == 0, "what had arrived was kept"
    assert await same(one, other, "maps")
    [kept] = await other.storage.volumes({LABEL_KEPT: "maps", "swiftbot.fleet": other.fleet})
    assert (kept.folder / "own").read_text() == "mine"


async def test_many_ask_for_one_volume_at_once(pair: tuple[Side, Side]) -> None:
    """Ten that want the same volume share one transfer; one who gives up waiting does not end it for the others."""
    one, other = pair
    await one.change("maps", fill(8))
    asking = [asyncio.create_task(other.transfers.bring_volume("maps")) for _ in range(10)]
    await moved(other, 1)
    asking[0].cancel()
    done = await asyncio.gather(*asking, return_exceptions=True)
    assert isinstance(done[0], asyncio.CancelledError)
    assert len({repr(each) for each in done[1:]}) == 1
    assert await same(one, other, "maps")


# --- images -----------------------------------------------------------------------------------------------------


@pytest.fixture
async def second(folder: Path) -> AsyncIterator[str]:
    """A second Podman storage: the API socket's URL of a service of the test's own."""
    async with podman_service(folder.parent / "second") as url:
        yield url


async def _load(storage: PodmanEngine, reference: str, layers: list[dict[str, bytes]]) -> str:
    archive, image = small_image(reference, layers)
    await storage.load_image(lambda: iter([archive]))
    return image


async def test_an_image_spreads_without_a_registry(fleet: Sides, second: str, folder: Path) -> None:
    """Of an image only the layers that are missing come; who got it gives it on when the one it came from is gone."""
    one, other = await fleet.start(0), await fleet.start(1, podman=second)
    await fleet.settled()
    tag = f"localhost/{fleet.fleet}/image"
    lower, upper = {"usr/lib/a": os.urandom(3 * MIB)}, {"usr/lib/b": os.urandom(MIB)}
    try:
        first = await _load(one.storage, f"{tag}:1", [lower])
        both = await _load(one.storage, f"{tag}:2", [lower, upper])
        brought = await other.transfers.bring_image(f"{tag}:1", "g0")
        assert brought.gateway == "g0"
        assert brought.wire_bytes > 3 * MIB
        assert (await other.storage.image(f"{tag}:1")).id == first
        brought = await other.transfers.bring_image(f"{tag}:2", "g0")
        assert MIB < brought.wire_bytes < 2 * MIB, "the lower layer was there already"
        facts = await other.storage.image(f"{tag}:2")
        assert facts.id == both
        assert facts.layers == (await one.storage.image(f"{tag}:2")).layers
        assert (await other.transfers.bring_image(f"{tag}:2")).wire_bytes == 0
        assert f"{tag}:2" in other.transfers.images()
        assert not other.transfers.refused
        await fleet.stop(0)
        async with podman_service(folder.parent / "third") as url:
            third = await fleet.start(2, podman=url)
            await fleet.settled()
            brought = await third.transfers.bring_image(f"{tag}:2")
            assert brought.gateway == "g1"
            assert (await third.storage.image(f"{tag}:2")).id == both
            await fleet.stop(2)
    finally:
        storage = PodmanEngine.for_transfers()
        for number in (2, 1):
            await storage.remove_image(f"{tag}:{number}")
        storage.close()


async def test_images_that_are_not_what_they_say(fleet: Sides, second: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A layer whose content is not its digest, although its chunks match, is refused, and nothing of it is left."""
    one, other = await fleet.start(0), await fleet.start(1, podman=second)
    await fleet.settled()
    reference = f"localhost/{fleet.fleet}/image:1"
    try:
        await _load(one.storage, reference, [{"a": os.urandom(MIB)}])
        [layer] = (await one.storage.image(reference)).layers

        def lie(self: Any, digest: str, body: Any) -> None:
            data = body.read()
            if digest == layer:
                data = data[:-1] + bytes([data[-1] ^ 1])
            draft = self.offers.draft()
            draft.write_bytes(data)
            digests = Digests(self.chunk_bytes)
            digests.update(data)
            self.offers.add(digests.manifest("blob", digest), draft)

        monkeypatch.setattr("appliance.pool.volumes.source.Giver._keep_blob", lie)
        with pytest.raises(PayloadError, match="something else"):
            await other.transfers.bring_image(reference, "g0")
        assert other.transfers.refused["transfer bad blob"] == 1
        assert not await other.storage.has_image(reference)
        assert not [each for each in (fleet.folder / "g1" / "transfer").rglob("*") if layer in each.name]
        with pytest.raises(NotFoundError):
            await other.transfers.bring_image(f"localhost/{fleet.fleet}/absent:1", "g0")
        with pytest.raises(RefusedError, match="not given"):
            await other.transfers.bring_image("docker.io/library/debian:12", "g0")
    finally:
        await one.storage.remove_image(reference)
