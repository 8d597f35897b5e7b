"""Podman's images and volumes as transfers need them: the slow calls, on a client of their own.

An image of 150 MB takes Podman three seconds to give; on the threads that start containers that would be three
seconds without starts. All traps found here are of Podman 4.3: `pull` takes no transport but a registry's over the
API, `get` gives layers uncompressed only as docker-archive, and `load` of an OCI archive needs no layer that is in
the storage already.
"""

import tarfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import requests
from msgspec import Struct

from appliance.errors import NotFoundError, PoolError, PrerequisiteError
from appliance.pool.engine import PodmanEngine

_MOST_IMAGES = 500


class ImageFacts(Struct, frozen=True, kw_only=True):
    """An image as it is in the storage. `layers` are the SHA-256 of the uncompressed layers, the lowest first."""

    id: str
    """SHA-256 of its configuration, hexadecimal."""
    layers: tuple[str, ...]
    size_bytes: int = 0


class FoundVolume(Struct, frozen=True, kw_only=True):
    """A named volume that is there."""

    name: str
    folder: Path
    labels: dict[str, str]


class PodmanStorage(PodmanEngine):
    """Images and volumes of the user's Podman."""

    def __init__(self, url: str = "", *, threads: int = 2, timeout_s: float = 300.0) -> None:
        super().__init__(url, threads=threads, timeout_s=timeout_s)

    # --- volumes ----------------------------------------------------------------------------------------------

    async def volume(self, name: str) -> FoundVolume:
        """Return a named volume; NotFoundError when there is none."""

        def work(client: Any) -> FoundVolume:
            response = client.api.get(f"/volumes/{name}/json")
            if response.status_code == requests.codes.not_found:
                raise NotFoundError(f"there is no volume {name}")
            response.raise_for_status()
            found = response.json()
            return FoundVolume(
                name=str(found["Name"]), folder=Path(found["Mountpoint"]), labels=dict(found.get("Labels") or {})
            )

        return await self._ask(f"volume {name}", work)

    async def remove_volume(self, name: str) -> None:
        """Remove a volume that no container uses; no error when it is gone."""

        def work(client: Any) -> None:
            response = client.api.delete(f"/volumes/{name}")
            if response.status_code != requests.codes.not_found:
                response.raise_for_status()

        await self._ask(f"remove volume {name}", work)

    async def volumes(self, labels: Mapping[str, str]) -> list[FoundVolume]:
        """Return the volumes that have all these labels, by name."""

        def work(client: Any) -> list[FoundVolume]:
            response = client.api.get("/volumes/json")
            response.raise_for_status()
            found = [
                FoundVolume(name=each["Name"], folder=Path(each["Mountpoint"]), labels=dict(each.get("Labels") or {}))
                for each in response.json() or ()
            ]
            return sorted((each for each in found if labels.items() <= each.labels.items()), key=lambda each: each.name)

        return await self._ask("list volumes", work)

    # --- images -----------------------------------------------------------------------------------------------

    async def image(self, reference: str) -> ImageFacts:
        """Return what an image is made of; NotFoundError when it is not there."""
        return await self._ask(f"image {reference}", lambda client: _facts(client, reference))

    async def layers(self) -> frozenset[str]:
        """Return the SHA-256 of all uncompressed layers of the images in the storage."""

        def work(client: Any) -> frozenset[str]:
            response = client.api.get("/images/json")
            response.raise_for_status()
            found: set[str] = set()
            for each in response.json()[:_MOST_IMAGES]:
                try:
                    found.update(_facts(client, str(each["Id"])).layers)
                except NotFoundError:
                    continue  # removed just now
            return frozenset(found)

        return await self._ask("layers of images", work)

    async def export_image(self, image_id: str, take: Callable[[str, BinaryIO], None]) -> None:
        """Have Podman give an image; `take` gets each blob's SHA-256 and its bytes, uncompressed, on a thread."""

        def work(client: Any) -> None:
            response = client.api.get(f"/images/{image_id}/get", params={"format": "docker-archive"}, stream=True)
            try:
                if response.status_code == requests.codes.not_found:
                    raise NotFoundError(f"there is no image {image_id[:12]}")
                response.raise_for_status()
                with tarfile.open(fileobj=cast("BinaryIO", response.raw), mode="r|") as tar:
                    for member in tar:
                        stem, _, suffix = member.name.partition(".")
                        if len(stem) == 64 and suffix in ("tar", "json") and member.isreg():
                            body = tar.extractfile(member)
                            if body is not None:
                                take(stem, cast("BinaryIO", body))
            finally:
                response.close()

        try:
            await self._ask(f"export image {image_id[:12]}", work)
        except tarfile.TarError as error:
            raise PoolError(f"Podman gave image {image_id[:12]} as no archive: {error}") from error

    async def load_image(self, archive: Callable[[], Iterator[bytes]]) -> None:
        """Load an OCI archive, made piece by piece; PoolError when Podman will not."""

        def work(client: Any) -> None:
            response = client.api.post(
                "/images/load", data=archive(), headers={"content-type": "application/x-tar"}, timeout=600
            )
            response.raise_for_status()

        await self._ask("load image", work)

    async def remove_image(self, reference: str) -> None:
        """Take a name from an image, and remove it when that was the last; no error when it is gone."""

        def work(client: Any) -> None:
            response = client.api.delete(f"/images/{reference}", params={"force": "false"})
            if response.status_code != requests.codes.not_found:
                response.raise_for_status()

        await self._ask(f"remove image {reference}", work)

    async def has_image(self, reference: str) -> bool:
        """Whether an image is there."""
        try:
            await self.image(reference)
        except (NotFoundError, PrerequisiteError):
            return False
        return True


def _facts(client: Any, reference: str) -> ImageFacts:
    response = client.api.get(f"/images/{reference}/json")
    if response.status_code == requests.codes.not_found:
        raise NotFoundError(f"there is no image {reference}", remedy="swiftbot images list")
    response.raise_for_status()
    found = cast("dict[str, Any]", response.json())
    layers = cast("list[str]", cast("dict[str, Any]", found.get("RootFS") or {}).get("Layers") or [])
    return ImageFacts(
        id=str(found["Id"]).removeprefix("sha256:"),
        layers=tuple(str(each).removeprefix("sha256:") for each in layers),
        size_bytes=int(found.get("Size", 0)),
    )
