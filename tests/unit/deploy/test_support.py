"""What goes to support has what it needs and no key, password or passphrase."""

import os
import tarfile
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.config import GatewayConfig
from appliance.deploy import support
from appliance.deploy.layout import Layout
from appliance.deploy.support import Cleaner
from appliance.errors import ConfigError, UnreachableError

pytestmark = pytest.mark.anyio
PASSPHRASE = "correct horse battery staple"  # noqa: S105 - what is looked for
UPSTREAM = "sk-upstream-0123456789abcdef"
SIGNING = "9f86d081884c7d659a2feaa0c55ad015"


def journal(key: str) -> str:
    """A program in the place of journalctl and systemctl, whose lines have every secret in some form."""
    lines = [
        "2026-11-27T10:00:00 gw-1 swiftbot: all is well",
        '{"event": "asked", "api_key": "another-secret-value", "url": "https://ann:hunter2222@example.org/x"}',
        f"Authorization failed for {UPSTREAM}",
        f"SWIFTBOT_PASSPHRASE={PASSPHRASE.replace(' ', '_')} token: abcdef-123456",
        f"signing with {SIGNING}",
        *key.splitlines(),
    ]
    return "#!/bin/sh\ncat <<'EOF'\n" + "\n".join(lines) + "\nEOF\n"


@pytest.fixture
def key() -> str:
    """A private key in PEM."""
    return Ed25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    ).decode()  # fmt: skip


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str) -> Path:
    """A machine with secrets everywhere; returns its configuration."""
    for name in ("bin", "etc", "data", "log"):
        (tmp_path / name).mkdir()
    for program in ("journalctl", "systemctl"):
        (tmp_path / "bin" / program).write_text(journal(key))
        (tmp_path / "bin" / program).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    monkeypatch.setenv("SWIFTBOT_PASSPHRASE", PASSPHRASE)
    (tmp_path / "etc/upstream").write_text(UPSTREAM)
    (tmp_path / "etc/signing").write_text(f"hex:{SIGNING}")
    (tmp_path / "etc/gateway-gw-1.pem").write_text(key)
    (tmp_path / "log/yard-1.mcap").write_bytes(b"x" * 100)
    config = tmp_path / "etc/gateway.toml"
    config.write_text(
        f'id = "gw-1"\nfleet = "yard"\ndata_dir = "{tmp_path}/data"\n[record]\ndirectory = "{tmp_path}/log"\n'
        f'[llm]\nupstream_key_file = "{tmp_path}/etc/upstream"\n[plane]\nkeys = "{tmp_path}/etc/gateway-gw-1.pem"\n'
        f'[[robots.mavlink]]\nlisten = "udp://127.0.0.1:14550"\nsigning = "{tmp_path}/etc/signing"\n'
    )
    return config


async def collected(config: Path, file: Path, *, said: object = "fine") -> support.Collected:
    """Collect."""

    async def doctor(_: GatewayConfig | None) -> object:
        return {"checks": said}

    async def fleet(_: GatewayConfig) -> object:
        raise UnreachableError("no gateway answers", remedy="start one")

    layout = Layout(config.parent / "none")
    return await support.collect(file, config, doctor=doctor, fleet=fleet, layout=layout, say=lambda _: None)


def contents(file: Path) -> dict[str, bytes]:
    """What is in a file for support."""
    with tarfile.open(file) as tar:
        found = ((each.name.removeprefix("support/"), tar.extractfile(each)) for each in tar.getmembers())
        return {name: data.read() for name, data in found if data is not None}


async def test_no_secret_is_in_it(machine: Path, tmp_path: Path, key: str) -> None:
    """Key files, the upstream's key, signing keys, passwords, tokens and passphrases: in no part, in no form."""
    file = tmp_path / "support.tar.gz"
    await collected(machine, file, said={"passphrase": PASSPHRASE, "told": f"it is {PASSPHRASE}", "pem": key})
    everything = b"\n".join(contents(file).values())
    body = "".join(line for line in key.splitlines() if "-----" not in line)
    secrets = (PASSPHRASE, PASSPHRASE.replace(" ", "_"), UPSTREAM, SIGNING, body, "hunter2222", "another-secret-value")
    for secret in (*secrets, "abcdef-123456", "PRIVATE KEY"):
        assert secret.encode() not in everything, secret
    assert file.stat().st_mode & 0o777 == 0o600


async def test_what_support_needs_is_in_it(machine: Path, tmp_path: Path) -> None:
    """Checks, versions, configuration, disks, log lines and names of logs; and why a part is not."""
    found = await collected(machine, tmp_path / "support.tar.gz")
    parts = contents(tmp_path / "support.tar.gz")
    assert b"all is well" in parts["journal/swiftbot-gateway.service.txt"]
    assert b'"checks"' in parts["doctor.json"]
    assert b'"gw-1"' in parts["configuration.json"]
    assert b"yard-1.mcap" in parts["logs.json"]
    assert b"eclipse-zenoh" in parts["versions.json"]
    assert b"data_dir" in parts["machine.json"]
    assert list(found.missing) == ["fleet.json"]
    assert b"no gateway answers" in parts["missing.json"]


async def test_without_a_configuration_it_is_a_finding(tmp_path: Path) -> None:
    """A gateway whose configuration is broken is just what support is asked about."""
    config = tmp_path / "gateway.toml"
    config.write_text("id = ")
    found = await collected(config, tmp_path / "file")
    assert "is not TOML" in found.missing["configuration.json"]
    with pytest.raises(ConfigError, match="exists"):
        await collected(config, tmp_path / "file")


def test_plain_lines_stay_as_they_are() -> None:
    """What is no secret is not touched."""
    line = b"10:00:00 gw-1 run t-1/s1 succeeded after 14.0 ms (key task/t-1, max_tokens 5)\n"
    assert Cleaner(("verysecretvalue",)).clean(line) == line
