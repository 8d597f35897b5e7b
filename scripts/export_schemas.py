"""Write the JSON schemas of the shared structs to docs/schemas, for tools in other languages and for Foxglove.

They are made, never edited; a test fails when they are behind `appliance/model`. Run from the project's root:

    python scripts/export_schemas.py
"""

import inspect
import json
import sys
from pathlib import Path

import msgspec

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from appliance import model  # noqa: E402 - a script finds the project beside itself
from appliance.cli.printed import PRINTED  # noqa: E402

FOLDER = ROOT / "docs" / "schemas"


def schemas() -> dict[str, str]:
    """Return file name -> text of the schema of every public struct of the model."""
    structs = {
        name: value
        for name, value in vars(model).items()
        if inspect.isclass(value)
        and issubclass(value, msgspec.Struct)
        and value.__module__.startswith(f"{model.__name__}.")
        and not name.startswith("_")
    }
    made: dict[str, str] = {}
    for name, struct in sorted(structs.items()):
        schema = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": name,
            **msgspec.json.schema(struct),
        }
        made[f"{name}.json"] = json.dumps(schema, indent=1, sort_keys=True) + "\n"
    return made


def printed() -> dict[str, str]:
    """Return file name -> text of the schema of what each command prints with `--json`."""
    made: dict[str, str] = {}
    for command, kind in sorted(PRINTED.items()):
        schema = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": f"swiftbot {command} --json",
            **msgspec.json.schema(kind),
        }
        made[f"{command.replace(' ', '-')}.json"] = json.dumps(schema, indent=1, sort_keys=True) + "\n"
    return made


def write(folder: Path, wanted: dict[str, str]) -> None:
    """Write what changed, remove what is no schema any more."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in wanted.items():
        file = folder / name
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")
            print(f"wrote {file.relative_to(ROOT)}")
    for file in folder.glob("*.json"):
        if file.name not in wanted:
            file.unlink()
            print(f"removed {file.relative_to(ROOT)}")


def main() -> None:
    """Write both kinds."""
    write(FOLDER, schemas())
    write(FOLDER / "commands", printed())


if __name__ == "__main__":
    main()
