"""Files of handlers: kept by content, fetched from elsewhere, bounded, verified."""

import asyncio
import hashlib
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import NotFoundError, PayloadError, RefusedError, UnreachableError
from appliance.model.task_api import ArtifactAsk, ArtifactKeep, ArtifactKept, ArtifactPiece
from appliance.tasks import artifacts
from appliance.tasks.artifacts import MAX_OWNER, MAX_WAITING, PIECE, ArtifactCopies, Artifacts, Reference

pytestmark = pytest.mark.anyio


def store(path: Path, gateway: str = "gw-1", max_bytes: int = 4 << 20) -> Artifacts:
    """Return a store."""
    return Artifacts(path / gateway, gateway=gateway, max_bytes=max_bytes)


async def test_the_same_bytes_are_kept_once(tmp_path: Path) -> None:
    """A repeated attempt stores its picture again under the same name on disk."""
    files = store(tmp_path)
    one = await files.put("a.png", b"picture", "image/png", owner="task/t-1")
    other = await files.put("b.png", b"picture", "image/png", owner="task/t-1")
    assert one.artifact == other.artifact == hashlib.sha256(b"picture").hexdigest()
    assert len(list((tmp_path / "gw-1").glob("??/*"))) == 1


async def test_a_file_comes_from_the_gateway_that_made_it_piece_by_piece(tmp_path: Path) -> None:
    """Larger than a piece, fetched in pieces, verified and kept here afterwards."""
    maker, here = store(tmp_path, "gw-1"), store(tmp_path, "gw-2")
    data = bytes(range(256)) * (PIECE // 128)
    reference = msgspec.to_builtins(await maker.put("video.mp4", data, "video/mp4", owner="task/t-1"))
    asked: list[int] = []

    async def ask(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        assert member == "gw-1"
        asked.append(piece.offset)
        return await maker.piece(piece)

    assert await here.get(reference, ask=ask, members=frozenset({"gw-1", "gw-2"}), owner="task/t-1") == data
    assert asked == [0, PIECE]
    assert here.path(reference["artifact"]).exists()


async def test_bytes_that_do_not_match_their_digest_are_refused(tmp_path: Path) -> None:
    """A gateway that sends other bytes is not believed."""

    async def lie(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        return ArtifactPiece(data=b"other", size=5)

    reference = {"artifact": hashlib.sha256(b"picture").hexdigest(), "gateway": "gw-1"}
    with pytest.raises(PayloadError, match="does not match its digest"):
        await store(tmp_path, "gw-2").get(reference, ask=lie, members=frozenset({"gw-1"}), owner="task/t-1")


async def test_a_file_that_nobody_has_is_not_found(tmp_path: Path) -> None:
    """The error names the gateway that made it."""

    async def ask(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        raise NotFoundError("no")

    reference = {"artifact": "0" * 64, "gateway": "gw-7", "name": "x"}
    with pytest.raises(NotFoundError, match="no gateway") as caught:
        await store(tmp_path).get(reference, ask=ask, members=frozenset({"gw-1", "gw-2"}), owner="task/t-1")
    assert "gw-7" in caught.value.remedy


async def test_hostile_references_and_oversize_files_are_refused(tmp_path: Path) -> None:
    """A path in place of a digest reads nothing; a file beyond the bound is refused before it is written."""
    files = store(tmp_path, max_bytes=10)
    for bad in ("../../etc/passwd", "", "a" * 63, "G" * 64):
        with pytest.raises(PayloadError):
            await files.piece(ArtifactAsk(artifact=bad))
    with pytest.raises(RefusedError, match="more than"):
        await files.put("big", b"x" * 11, "text/plain", owner="task/t-1")


async def test_a_full_disk_is_an_error_that_names_the_place(tmp_path: Path) -> None:
    """What cannot be written is refused with the cause, and leaves no half file."""
    blocked = tmp_path / "gw-1"
    blocked.write_text("a file where the folder should be")
    with pytest.raises(RefusedError, match="could not be stored") as caught:
        await store(tmp_path).put("a", b"x", "text/plain", owner="task/t-1")
    assert str(blocked) in caught.value.remedy


async def test_files_without_end_leave_the_disk_its_reserve(tmp_path: Path) -> None:
    """Where less than the reserve would be left a file is refused, told why, and nothing of it lies there."""
    files = Artifacts(tmp_path / "gw-1", gateway="gw-1", max_bytes=100, reserve_bytes=2**60)
    with pytest.raises(RefusedError, match="stay free") as caught:
        await files.put("a", b"x", "text/plain", owner="task/t-1")
    assert str(tmp_path) in caught.value.remedy
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


async def test_what_cannot_be_kept_here_is_given_all_the_same(tmp_path: Path) -> None:
    """A file of another gateway reaches the handler that asked for it, though this gateway has no room for a copy."""
    maker = store(tmp_path, "gw-1")
    here = Artifacts(tmp_path / "gw-2", gateway="gw-2", max_bytes=100, reserve_bytes=2**60)
    reference = msgspec.to_builtins(await maker.put("a", b"picture", "image/png", owner="task/t-1"))

    async def ask(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        return await maker.piece(piece)

    assert await here.get(reference, ask=ask, members=frozenset({"gw-1", "gw-2"}), owner="task/t-1") == b"picture"
    assert not here.path(reference["artifact"]).exists()


@given(
    st.lists(
        st.tuples(
            st.sampled_from(("put", "forget")), st.sampled_from(("task/a", "task/b", "x/ü é/1")), st.integers(0, 3)
        ),
        max_size=30,
    )
)
def test_a_file_is_there_as_long_as_an_owner_has_it(steps: list[tuple[str, str, int]]) -> None:
    """Whatever is stored and forgotten in whatever order, the files that are there are those that somebody owns."""

    async def play(folder: Path) -> None:
        files = Artifacts(folder, gateway="gw-1", max_bytes=100)
        owned: dict[str, set[str]] = {}
        for step, owner, content in steps:
            if step == "put":
                stored = await files.put("f", b"%d" % content, "text/plain", owner=owner)
                owned.setdefault(owner, set()).add(stored.artifact)
            else:
                before = set[str]().union(*owned.values())
                owned.pop(owner, None)
                assert await files.forget(owner) == len(before - set[str]().union(*owned.values()))
            assert {path.name for path in folder.glob("??/*")} == set[str]().union(*owned.values())
            assert {*await files.owners()} == {*owned}
            for each, digests in owned.items():
                assert await files.owned(each) == digests

    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(play(Path(folder)))


async def test_only_what_a_crash_left_half_written_goes_without_an_owner(tmp_path: Path) -> None:
    """A whole file without an owner stays however old it is: a record of an earlier version may refer to it."""
    files = store(tmp_path)
    old = files.path(hashlib.sha256(b"old").hexdigest())
    old.parent.mkdir(parents=True)
    old.write_bytes(b"old")
    half, writing = (Path(tempfile.mkstemp(dir=old.parent)[1]) for _ in range(2))
    for path in (old, half):
        os.utime(path, (1.0, 1.0))
    assert await files.forget_temporary(60.0) == 1
    assert sorted(old.parent.iterdir()) == sorted([old, writing])


@pytest.mark.parametrize("owner", ["", "x" * (MAX_OWNER + 1), "ü" * (MAX_OWNER // 6 + 1)])
async def test_an_owner_is_a_key(tmp_path: Path, owner: str) -> None:
    """An owner that is no key of a record is refused."""
    with pytest.raises(PayloadError, match="owner"):
        await store(tmp_path).put("a", b"x", "text/plain", owner=owner)


async def test_a_copy_is_kept_for_its_owner(tmp_path: Path) -> None:
    """A copy is fetched once, verified, and goes with its last owner; a wrong one is not kept."""
    maker, other = store(tmp_path, "gw-1"), store(tmp_path, "gw-2")
    made = await maker.put("a", b"picture", "image/png", owner="task/t-1")
    asked: list[str] = []

    async def ask(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        asked.append(member)
        return await maker.piece(piece)

    for owner in ("task/t-1", "task/t-2"):
        keep = ArtifactKeep(artifact=made.artifact, source="gw-1", owner=owner)
        assert await other.keep(keep, ask=ask) == ArtifactKept(artifact=made.artifact, gateway="gw-2")
    assert asked == ["gw-1"]
    assert [await other.forget("task/t-1"), await other.forget("task/t-2")] == [0, 1]

    async def lie(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        return ArtifactPiece(data=b"other", size=5)

    with pytest.raises(PayloadError, match="does not match"):
        await other.keep(ArtifactKeep(artifact=made.artifact, source="gw-1", owner="task/t-1"), ask=lie)
    with pytest.raises(PayloadError, match="is not an artifact"):
        await other.keep(ArtifactKeep(artifact="../../etc", source="gw-1", owner="task/t-1"), ask=lie)
    assert await other.owners() == ()


def spreader(places: Sequence[str], *, dead: frozenset[str] = frozenset(), copies: int = 2) -> ArtifactCopies:
    """Return what copies to gateways, of which some do not answer."""

    async def ask(gateway: str, asked: ArtifactKeep) -> ArtifactKept:
        if gateway in dead:
            raise UnreachableError(f"{gateway} does not answer")
        return ArtifactKept(artifact=asked.artifact, gateway=gateway)

    return ArtifactCopies(gateway="gw-1", copies=copies, places=lambda _: places, ask=ask)


REFERENCE = Reference(artifact="0" * 64, name="a", media_type="text/plain", bytes=1, gateway="gw-1")


async def test_copies_go_to_the_next_gateway_that_answers() -> None:
    """A gateway that does not answer is passed over; where too few do, those that hold it are named."""
    copies = spreader(["gw-3", "gw-1", "gw-2"], dead=frozenset({"gw-3"}))
    assert await copies.spread(REFERENCE, "task/t-1", copies=2) == ("gw-1", "gw-2")
    assert await copies.spread(REFERENCE, "task/t-1", copies=3) == ("gw-1", "gw-2")
    assert await spreader(["gw-1"]).spread(REFERENCE, "task/t-1", copies=2) == ("gw-1",)


async def test_files_that_are_not_copied_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """After some tries, or where too many wait, a file is said to lie on this gateway alone."""
    monkeypatch.setattr(artifacts, "AGAIN_S", 0.0)
    copies = spreader(["gw-1", "gw-2"], dead=frozenset({"gw-2"}))
    for _ in range(MAX_WAITING + 1):
        copies.later(REFERENCE, "task/t-1")
    assert copies.missed == 1
    running = asyncio.create_task(copies.run())
    async with asyncio.timeout(20):
        while copies.missed < MAX_WAITING + 1:
            await asyncio.sleep(0.01)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


async def test_a_gateway_by_itself_copies_to_nobody_and_says_nothing() -> None:
    """A fleet of one gateway has no place for a copy: that is not counted as missed."""
    copies = spreader(["gw-1"])
    copies.later(REFERENCE, "task/t-1")
    running = asyncio.create_task(copies.run())
    await asyncio.sleep(0.05)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert copies.missed == 0
