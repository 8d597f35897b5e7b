"""Write `docs/configuration.md` from the configuration structs, so that it cannot fall behind them.

Each key's description is the string below its field in the source; its default is the struct's own.

Usage: write_configuration.py [--check]
"""

import ast
import importlib
import inspect
import sys
from pathlib import Path

import msgspec

ROOT = Path(__file__).resolve().parent.parent
TARGET = ROOT / "docs" / "configuration.md"
SECTIONS = (
    ("", "appliance.config", "GatewayConfig"),
    ("plane", "appliance.plane.settings", "PlaneConfig"),
    ("pool", "appliance.pool.settings", "PoolConfig"),
    ("pool.weights", "appliance.pool.settings", "Weights"),
    ("pool.pressure", "appliance.pool.settings", "PressureConfig"),
    ("pool.transfer", "appliance.pool.settings", "TransferConfig"),
    ("llm", "appliance.llm.settings", "LlmConfig"),
    ("safety", "appliance.llm.settings", "SafetyConfig"),
    ("safety.limits", "appliance.llm.settings", "RobotLimits"),
    ("robots", "appliance.robots.settings", "RobotsConfig"),
    ("robots.mavlink", "appliance.model.robot_api", "MavlinkLink"),
    ("floor", "appliance.floor.settings", "FloorConfig"),
    ("floor.robots", "appliance.floor.settings", "SizeConfig"),
    ("record", "appliance.record.settings", "RecordConfig"),
    ("tasks", "appliance.tasks.settings", "TasksConfig"),
    ("tasks.battery", "appliance.tasks.settings", "BatteryConfig"),
    ("tasks.detection", "appliance.tasks.settings", "DetectionConfig"),
    ("tasks.replan", "appliance.tasks.settings", "ReplanConfig"),
    ("tasks.migration", "appliance.tasks.settings", "MigrationConfig"),
    ("observe", "appliance.observe.settings", "ObserveConfig"),
)
HEAD = """# Configuration

A gateway reads one TOML file: `swiftbot gateway --config /etc/swiftbot/gateway.toml`. The recorder reads the same
file. It is read strictly: an unknown key or a wrong type ends the start with exit code 2 and names file and key.
Only `id` must be given. This page is made from the sources by `scripts/write_configuration.py`; do not edit it.

```toml
id = "gw-1"
fleet = "yard"
site = "/etc/swiftbot/site.toml"

[plane]
listen = ["tls/0.0.0.0:7447"]
keys = "/etc/swiftbot/keys/gateway-gw-1.pem"                                # docs/security.md
peers = {gw-1 = "tls/gw-1.example:7447", gw-2 = "tls/gw-2.example:7447"}   # the same in each gateway

[pool]
capacity = 8
floor = {base = 2, vision = 1}

[[robots.mavlink]]
listen = "udp://0.0.0.0:14550"
names = {"1" = "drone_1"}
```

Commands find their fleet by `--fleet` and `--dir` (a local fleet's state file) or by `--connect`; the environment
variables `SWIFTBOT_FLEET`, `SWIFTBOT_DIR` and `SWIFTBOT_CONNECT` say the same. To gateways with keys they connect with
those of `--keys` (`SWIFTBOT_KEYS`).

## Exit codes of `swiftbot`

| code | meaning |
| --- | --- |
"""


def fields(module: str, name: str) -> list[tuple[str, str, str, str]]:
    """Key, type, default and description of each field of a struct, in source order."""
    kind = getattr(importlib.import_module(module), name)
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    body = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name).body
    known = {field.name: field for field in msgspec.structs.fields(kind)}
    rows: list[tuple[str, str, str, str]] = []
    for at, node in enumerate(body):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        after = body[at + 1] if at + 1 < len(body) else None
        text = ""
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            text = " ".join(str(after.value.value).split())
        rows.append((node.target.id, ast.unparse(node.annotation), _default(known[node.target.id]), text))
    return rows


def _default(field: "msgspec.structs.FieldInfo") -> str:
    if field.default is not msgspec.NODEFAULT:
        value = field.default
    elif field.default_factory is not msgspec.NODEFAULT:
        value = field.default_factory()
    else:
        return "required"
    return "a section of its own" if isinstance(value, msgspec.Struct) else msgspec.json.encode(value).decode()


def exits() -> list[tuple[int, str]]:
    """Number and meaning of each exit code, in source order."""
    kind = importlib.import_module("appliance.errors").Exit
    body = next(node for node in ast.parse(inspect.getsource(kind)).body if isinstance(node, ast.ClassDef)).body
    texts = [
        " ".join(node.value.value.split())
        for node in body[1:]
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    return [(int(code), text) for code, text in zip(kind, texts, strict=True)]


def page() -> str:
    """The whole page."""
    parts = [HEAD + "\n".join(f"| {code} | {text} |" for code, text in exits()) + "\n"]
    for section, module, name in SECTIONS:
        kind = getattr(importlib.import_module(module), name)
        title = f"`[{section}]`" if section else "Top level"
        if section == "robots.mavlink":
            title = "`[[robots.mavlink]]`"
        parts.append(f"\n## {title}\n\n{inspect.cleandoc(kind.__doc__ or '')}\n")
        parts.append("| key | type | default | meaning |\n| --- | --- | --- | --- |")
        for key, annotation, default, text in fields(module, name):
            shown = annotation.replace("|", "\\|")
            parts.append(f"| `{key}` | `{shown}` | `{default}` | {text.replace('|', chr(92) + '|')} |")
    return "\n".join(parts) + "\n"


def main() -> int:
    """Write the page, or with --check say whether it is up to date."""
    if "--check" in sys.argv:
        return 0 if TARGET.read_text() == page() else 1
    TARGET.write_text(page())
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
