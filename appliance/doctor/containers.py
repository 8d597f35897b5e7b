"""The checks that ask Podman: through the API socket, as the pool does.

They exist apart because they have a seam of their own, the pool's `Engine`, and because the last of them is no
look but a trial: a container is started and removed, the only proof that runtime, ids and storage go together.
"""

import secrets
from collections.abc import Callable, Iterator

from appliance.doctor.check import SETUP, Check
from appliance.errors import SwiftbotError
from appliance.pool.engine import LIMITING, ContainerSpec, Engine, EngineFacts
from appliance.pool.images import build_command, reference
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import Catalogue


def podman_checks(facts: EngineFacts) -> Iterator[Check]:
    """Yield what follows from Podman's own account."""
    yield Check(name="podman api", ok=True, detail=f"Podman {facts.version}")
    yield Check(
        name="rootless", ok=facts.rootless, detail="yes" if facts.rootless else "Podman runs as root", remedy=SETUP
    )
    yield Check(
        name="storage",
        ok=facts.storage_driver == "overlay",
        detail=facts.storage_driver,
        remedy='driver = "overlay" in ~/.config/containers/storage.conf, then podman system reset (removes images)',
    )
    missing = ", ".join(sorted(LIMITING - facts.controllers))
    yield Check(
        name="limits",
        ok=facts.limits_enforced,
        detail="memory, CPU and process limits of containers hold"
        if facts.limits_enforced
        else f"cgroup {facts.cgroup_version}: containers' memory, CPU and processes are not limited"
        + (f" ({missing} not delegated)" if facts.cgroup_version == "v2" else ""),
        remedy="boot with cgroup v2; delegate cpu, memory and pids to users (docs/operations.md)",
        required=False,
    )


async def check_images(engine: Engine, catalogue: Catalogue, config: PoolConfig) -> tuple[list[Check], str]:
    """Return whether each image of the catalogue is there, and the first one that is."""
    present = {tag for image in await engine.images() for tag in image.tags}
    checks: list[Check] = []
    usable = ""
    for name, spec in catalogue.images.items():
        full = reference(spec, config)
        found = full in present
        usable = usable or (full if found else "")
        checks.append(
            Check(
                name=f"image {name}",
                ok=found,
                detail=full if found else f"{full} is not there",
                remedy=build_command(spec),
            )
        )
    return checks, usable


async def check_container(engine: Engine, image: str, runtime: str) -> Check:
    """Start a container as the pool does and remove it: the only proof that runtime, ids and storage go together."""
    name = f"swiftbot-doctor-{secrets.token_hex(4)}"
    spec = ContainerSpec(
        name=name,
        image=image,
        command=("/bin/true",),
        labels={"swiftbot.doctor": name},
        binds={},
        volumes={},
        environment={},
        cpu=1.0,
        memory_mb=64,
        pids=32,
        tmp_mb=4,
        runtime=runtime,
    )
    try:
        await engine.create(spec)
        try:
            await engine.start(name)
        finally:
            await engine.remove(name)
    except SwiftbotError as error:
        return Check(
            name="container",
            ok=False,
            detail=error.message,
            remedy=error.remedy
            or 'cgroups: runtime = "runc" in ~/.config/containers/containers.conf; overlay: see storage',
        )
    return Check(name="container", ok=True, detail=f"starts{f' with {runtime}' if runtime else ''}")


async def check_podman(make_engine: Callable[[], Engine], catalogue: Catalogue, config: PoolConfig) -> list[Check]:
    """Ask Podman through its API socket; what cannot be told without it is told as such."""
    try:
        engine = make_engine()
    except SwiftbotError as error:
        return _podman_silent(error)
    try:
        facts = await engine.facts()
        checks = list(podman_checks(facts))
        images, usable = await check_images(engine, catalogue, config)
        checks += images
        if usable:
            runtime = config.runtime or ("runc" if facts.cgroup_version == "v1" else "")
            checks.append(await check_container(engine, usable, runtime))
    except SwiftbotError as error:
        return _podman_silent(error)
    finally:
        engine.close()
    return checks


def _podman_silent(error: SwiftbotError) -> list[Check]:
    checks = [Check(name="podman api", ok=False, detail=error.message, remedy=error.remedy or SETUP)]
    checks += [
        Check(name=name, ok=False, detail="cannot be told: Podman does not answer", remedy="first see to: podman api")
        for name in ("storage", "images", "container")
    ]
    return checks
