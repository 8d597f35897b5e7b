"""Files of handlers: kept by content, fetched from elsewhere, bounded, verified."""

import hashlib
from pathlib import Path

import msgspec
import pytest

from appliance.errors import NotFoundError, PayloadError, RefusedError
from appliance.tasks.api import ArtifactAsk, ArtifactPiece
from appliance.tasks.artifacts import PIECE, Artifacts

pytestmark = pytest.mark.anyio


def store(path: Path, gateway: str = "gw-1", max_bytes: int = 4 << 20) -> Artifacts:
    """Return a store."""
    return Artifacts(path / gateway, gateway=gateway, max_bytes=max_bytes)


async def test_the_same_bytes_are_kept_once(tmp_path: Path) -> None:
    """A repeated attempt stores its picture again under the same name on disk."""
    files = store(tmp_path)
    one = await files.put("a.png", b"picture", "image/png")
    other = await files.put("b.png", b"picture", "image/png")
    assert one.artifact == other.artifact == hashlib.sha256(b"picture").hexdigest()
    assert sum(path.is_file() for path in (tmp_path / "gw-1").rglob("*")) == 1


async def test_a_file_comes_from_the_gateway_that_made_it_piece_by_piece(tmp_path: Path) -> None:
    """Larger than a piece, fetched in pieces, verified and kept here afterwards."""
    maker, here = store(tmp_path, "gw-1"), store(tmp_path, "gw-2")
    data = bytes(range(256)) * (PIECE // 128)
    reference = msgspec.to_builtins(await maker.put("video.mp4", data, "video/mp4"))
    asked: list[int] = []

    async def ask(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        assert member == "gw-1"
        asked.append(piece.offset)
        return await maker.piece(piece)

    assert await here.get(reference, ask=ask, members=frozenset({"gw-1", "gw-2"})) == data
    assert asked == [0, PIECE]
    assert here.path(reference["artifact"]).exists()


async def test_bytes_that_do_not_match_their_digest_are_refused(tmp_path: Path) -> None:
    """A gateway that sends other bytes is not believed."""

    async def lie(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        return ArtifactPiece(data=b"other", size=5)

    reference = {"artifact": hashlib.sha256(b"picture").hexdigest(), "gateway": "gw-1"}
    with pytest.raises(PayloadError, match="does not match its digest"):
        await store(tmp_path, "gw-2").get(reference, ask=lie, members=frozenset({"gw-1"}))


async def test_a_file_that_nobody_has_is_not_found(tmp_path: Path) -> None:
    """The error names the gateway that made it."""

    async def ask(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        raise NotFoundError("no")

    reference = {"artifact": "0" * 64, "gateway": "gw-7", "name": "x"}
    with pytest.raises(NotFoundError, match="no gateway") as caught:
        await store(tmp_path).get(reference, ask=ask, members=frozenset({"gw-1", "gw-2"}))
    assert "gw-7" in caught.value.remedy


async def test_hostile_references_and_oversize_files_are_refused(tmp_path: Path) -> None:
    """A path in place of a digest reads nothing; a file beyond the bound is refused before it is written."""
    files = store(tmp_path, max_bytes=10)
    for bad in ("../../etc/passwd", "", "a" * 63, "G" * 64):
        with pytest.raises(PayloadError):
            await files.piece(ArtifactAsk(artifact=bad))
    with pytest.raises(RefusedError, match="more than"):
        await files.put("big", b"x" * 11, "text/plain")


async def test_a_full_disk_is_an_error_that_names_the_place(tmp_path: Path) -> None:
    """What cannot be written is refused with the cause, and leaves no half file."""
    blocked = tmp_path / "gw-1"
    blocked.write_text("a file where the folder should be")
    with pytest.raises(RefusedError, match="could not be stored") as caught:
        await store(tmp_path).put("a", b"x", "text/plain")
    assert str(blocked) in caught.value.remedy


async def test_files_without_end_leave_the_disk_its_reserve(tmp_path: Path) -> None:
    """Where less than the reserve would be left a file is refused, told why, and nothing of it lies there."""
    files = Artifacts(tmp_path / "gw-1", gateway="gw-1", max_bytes=100, reserve_bytes=2**60)
    with pytest.raises(RefusedError, match="stay free") as caught:
        await files.put("a", b"x", "text/plain")
    assert str(tmp_path) in caught.value.remedy
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


async def test_what_cannot_be_kept_here_is_given_all_the_same(tmp_path: Path) -> None:
    """A file of another gateway reaches the handler that asked for it, though this gateway has no room for a copy."""
    maker = store(tmp_path, "gw-1")
    here = Artifacts(tmp_path / "gw-2", gateway="gw-2", max_bytes=100, reserve_bytes=2**60)
    reference = msgspec.to_builtins(await maker.put("a", b"picture", "image/png"))

    async def ask(member: str, piece: ArtifactAsk) -> ArtifactPiece:
        return await maker.piece(piece)

    assert await here.get(reference, ask=ask, members=frozenset({"gw-1", "gw-2"})) == b"picture"
    assert not here.path(reference["artifact"]).exists()
