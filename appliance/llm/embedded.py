"""The planner that comes with the program: a folder of the package, named `embedded` in the configuration."""

from pathlib import Path

EMBEDDED = "embedded"
FOLDER = Path(__file__).with_name("planner")


def folder_of(model: str) -> str:
    """Return the folder of a model as the configuration names it: `embedded`, a path, or "" for none."""
    return str(FOLDER) if model == EMBEDDED else str(Path(model).expanduser()) if model else ""


def remedy_of(folder: str) -> str:
    """Return what to do about a folder that is no model's."""
    if Path(folder) == FOLDER:
        return 'this installation lacks its planner: install it again, or set llm.local_model to "" for none'
    return 'set llm.local_model to "embedded", to an onnxruntime-genai folder, or to "" for none'
