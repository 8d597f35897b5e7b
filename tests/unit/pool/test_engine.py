"""What is asked of Podman, against a socket that answers as it does."""

import asyncio
import json
from pathlib import Path

import pytest

from appliance.errors import PrerequisiteError
from appliance.pool.engine import PodmanEngine

pytestmark = pytest.mark.anyio
GONE = {"cause": "image not known", "message": "86ecc89b775d: image not known", "response": 500}
THERE = [{"Id": "sha256:0123456789abcdef", "RepoTags": ["localhost/swiftbot/base:1"], "Size": 7}]


@pytest.mark.parametrize(("failures", "found"), [(1, True), (99, False)])
async def test_an_image_that_goes_while_images_are_listed_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failures: int, found: bool
) -> None:
    """Podman fails the whole list when one of them is removed meanwhile: it is asked again, a few times."""
    monkeypatch.setattr("appliance.pool.engine._LIST_PAUSE_S", 0.0)
    lists = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal lists
        while request := await reader.readline():
            while (await reader.readline()).strip():
                pass
            status, answer = "200 OK", json.dumps({"Version": "4.3.1", "ApiVersion": "1.41", "Components": []})
            if b"images/json" in request:
                lists += 1
                status, answer = ("500 E", json.dumps(GONE)) if lists <= failures else ("200 OK", json.dumps(THERE))
            writer.write(f"HTTP/1.1 {status}\r\nContent-Length: {len(answer)}\r\n\r\n{answer}".encode())
            await writer.drain()
        writer.close()

    path = tmp_path / "podman.sock"
    async with await asyncio.start_unix_server(serve, path):
        engine = PodmanEngine(f"unix://{path}")
        try:
            if found:
                (image,) = await engine.images()
                assert image.tags == ("localhost/swiftbot/base:1",)
            else:
                with pytest.raises(PrerequisiteError):
                    await engine.images()
        finally:
            engine.close()
    assert lists == (2 if found else 4)
