"""Handlers of skills are others' code: what one that is hostile can reach from its container."""

import os
import subprocess
from pathlib import Path

import pytest
from pool_bench import Bench

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(400)]


async def test_hardening(bench: Bench) -> None:
    """Inside, nothing can be written but a bounded /tmp, there is no network, no capability and no way to any."""
    pool = await bench.pool()
    await bench.ready(pool)
    result = (await bench.run(pool, "harden")).result
    assert result is not None
    for place in ("root", "usr", "skills", "runner"):
        assert result[place] == "OSError: Read-only file system", place
    assert result["tmp"] == "done"
    assert result["fill"] == "OSError: No space left on device"
    assert "unreachable" in result["net"]
    assert result["interfaces"] == ["lo"]
    assert set(result["caps"]) == {"0000000000000000"}
    assert (result["nnp"], result["seccomp"]) == ("1", "2")
    assert "not permitted" in result["chown"]
    assert "ro" in result["mount"].split(",")


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="asks by numbers of x86-64's system calls")
async def test_the_kernel_is_not_asked_for_namespaces(bench: Bench) -> None:
    """User namespaces, mounts, ptrace, io_uring and keys are refused; threads and programs work.

    With Podman's own profile most of them work, so it is the program's that refuses them.
    """
    pool = await bench.pool()
    await bench.ready(pool)
    result = (await bench.run(pool, "kernel")).result
    refused = dict.fromkeys(("user namespace", "mount", "ptrace", "io_uring", "keyctl"), "EPERM")
    assert result == refused | dict.fromkeys(("clone into a namespace", "clone3"), "ENOSYS") | {"program": 0}
    open_pool = await bench.pool(gateway="g2", seccomp_profile="podman")
    await bench.ready(open_pool)
    result = (await bench.run(open_pool, "kernel")).result
    assert result is not None
    assert [result[name] for name in ("user namespace", "ptrace")] == ["done", "done"]


def test_containers_cannot_fill_the_run_of_the_host(project_root: Path, tmp_path: Path) -> None:
    """The gateway's sockets are on a tmpfs of their own, mounted here with the unit's options: it is full at 64 MiB."""
    folder = project_root / "systemd"
    assert "RequiresMountsFor=/run/swiftbot\n" in (folder / "swiftbot-gateway.service").read_text()
    mount = dict(line.split("=", 1) for line in (folder / "run-swiftbot.mount").read_text().splitlines() if "=" in line)
    assert mount["Where"] == "/run/swiftbot"
    (tmp_path / "at").mkdir()
    made = f"mount -t {mount['Type']} -o {mount['Options']} tmpfs at"
    fill = [
        "unshare",
        "--map-root-user",
        "--mount",
        "sh",
        "-c",
        f"{made} && head -c 100M /dev/zero >at/full; stat -c %s at/full",
    ]
    done = subprocess.run(fill, cwd=tmp_path, text=True, capture_output=True, check=False)
    assert "No space left on device" in done.stderr
    assert int(done.stdout.splitlines()[-1]) <= 64 * 2**20
