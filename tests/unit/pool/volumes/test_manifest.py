"""Manifests: what a stranger's must pass, what is missing, what can be copied from an earlier state."""

import hashlib
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError, RefusedError
from appliance.model.transfer_api import Manifest
from appliance.pool.volumes.archive import Digests
from appliance.pool.volumes.protocol import check_manifest, missing, reusable, root_digest

CHUNK = 16 * 1024


def made(data: bytes, name: str = "v") -> Manifest:
    """Return the manifest of bytes."""
    digests = Digests(CHUNK)
    digests.update(data)
    return digests.manifest("volume", name)


@given(size=st.integers(0, 5 * CHUNK), pieces=st.integers(1, 7))
def test_manifest_names_every_chunk(size: int, pieces: int) -> None:
    """In whatever pieces the bytes pass, each chunk has its SHA-256, the spans cover all, and the checks pass."""
    data = bytes(index % 251 for index in range(size))
    digests = Digests(CHUNK)
    step = max(1, size // pieces)
    for start in range(0, size, step):
        digests.update(data[start : start + step])
    manifest = digests.manifest("volume", "v")
    check_manifest(manifest, kind="volume", name="v", most_bytes=size)
    assert sum(manifest.span(index)[1] for index in range(manifest.count)) == size
    for index in range(manifest.count):
        offset, length = manifest.span(index)
        assert hashlib.sha256(data[offset : offset + length]).digest() == manifest.chunk(index)
    assert manifest == made(data)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"kind": "blob"}, PayloadError),
        ({"name": "other"}, PayloadError),
        ({"size_bytes": -1}, PayloadError),
        ({"size_bytes": 2**62}, RefusedError),
        ({"chunk_bytes": 1}, PayloadError),
        ({"chunk_bytes": 2**40}, PayloadError),
        ({"chunks": b""}, PayloadError),
        ({"chunks": bytes(32 * 10_000)}, PayloadError),
        ({"chunks": bytes(95)}, PayloadError),
        ({"digest": "0" * 64}, PayloadError),
        ({"digest": "../../etc"}, PayloadError),
        ({"version": {"a": 0}}, PayloadError),
        ({"version": {"a": -5}}, PayloadError),
    ],
)
def test_hostile_manifests_are_refused(changes: dict[str, Any], error: type[Exception]) -> None:
    """Sizes, counts, digests and versions that cannot be are refused before anything is done with them."""
    manifest = msgspec.structs.replace(made(bytes(3 * CHUNK)), **changes)
    with pytest.raises(error):
        check_manifest(manifest, kind="volume", name="v", most_bytes=10 * CHUNK)


def test_size_is_part_of_the_digest() -> None:
    """The same chunks said to be of another size have another digest."""
    one = made(bytes(CHUNK))
    assert root_digest(CHUNK, CHUNK, one.chunks) != root_digest(CHUNK - 1, CHUNK, one.chunks)


@given(old=st.lists(st.integers(0, 5), max_size=8), new=st.lists(st.integers(0, 5), max_size=8), data=st.data())
def test_reuse_copies_only_what_is_the_same(old: list[int], new: list[int], data: st.DataObject) -> None:
    """What can be copied is needed, there, and of the same content; what is the same and there is found."""
    there, wanted = (made(b"".join(bytes([each]) * CHUNK for each in chunks)) for chunks in (old, new))
    have = data.draw(st.sets(st.sampled_from(range(there.count)))) if there.count else set()
    got = data.draw(st.sets(st.sampled_from(range(wanted.count)))) if wanted.count else set()
    needed = missing(wanted, got)
    assert sorted({*needed, *got}) == list(range(wanted.count))
    found = reusable(wanted, there, have, needed)
    assert all(index in needed and source in have and new[index] == old[source] for index, source in found.items())
    assert {index for index in needed if new[index] in {old[each] for each in have}} == set(found)
