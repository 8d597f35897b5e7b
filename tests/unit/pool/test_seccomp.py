"""The seccomp profile of containers: what it must never allow, and which one the settings choose."""

import json
from typing import Any

import pytest

from appliance.pool.settings import SECCOMP, PoolConfig

NEVER = {
    "unshare", "setns", "mount", "umount2", "pivot_root", "chroot", "ptrace", "process_vm_readv", "process_vm_writev",
    "keyctl", "add_key", "request_key", "bpf", "perf_event_open", "userfaultfd", "io_uring_setup", "fsopen",
    "open_tree", "move_mount", "kexec_load", "init_module", "finit_module", "delete_module", "clone3",
    "open_by_handle_at",
}  # fmt: skip
NAMESPACES = 0x7E020000
"""All flags of clone that make a namespace."""


@pytest.fixture
def rules() -> list[dict[str, Any]]:
    """What the profile says, rule by rule."""
    profile = json.loads(SECCOMP.read_text())
    assert profile["defaultAction"] == "SCMP_ACT_ERRNO"
    return profile["syscalls"]


def test_what_is_never_allowed(rules: list[dict[str, Any]]) -> None:
    """No rule allows it, with whatever capability or architecture."""
    allowed = {name for rule in rules if rule["action"] == "SCMP_ACT_ALLOW" for name in rule["names"]}
    assert allowed & NEVER == set()
    assert allowed >= {"read", "write", "futex", "execve", "fork", "vfork", "wait4", "mmap", "socket", "clone"}


def test_clone_makes_threads_and_no_namespaces(rules: list[dict[str, Any]]) -> None:
    """Its one rule compares all flags of namespaces with zero."""
    found = [rule for rule in rules if "clone" in rule["names"] and rule["action"] == "SCMP_ACT_ALLOW"]
    assert [rule["names"] for rule in found] == [["clone"]]
    assert found[0]["args"] == [{"index": 0, "value": NAMESPACES, "valueTwo": 0, "op": "SCMP_CMP_MASKED_EQ"}]


def test_which_profile_is_taken() -> None:
    """The program's own by default, one's own by its path, Podman's by name."""
    assert PoolConfig().seccomp_file() == str(SECCOMP)
    assert PoolConfig(seccomp_profile="/etc/mine.json").seccomp_file() == "/etc/mine.json"
    assert PoolConfig(seccomp_profile="podman").seccomp_file() == ""
