"""A small fake of `ctx`, the seam between handlers and appliance, and handlers loaded as the runner does."""

import hashlib
import importlib.util
import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import pytest
from PIL import Image, ImageDraw

from appliance.skills.catalogue import SKILLS
from appliance.skills.sites import load_site


class Fail(Exception):  # noqa: N818 - the runner's name for it
    """Stands in for the runner's `ctx.Fail`."""

    def __init__(self, message: str, remedy: str = "", retryable: bool = False) -> None:
        super().__init__(message)
        self.message, self.remedy, self.retryable = message, remedy, retryable


class CallError(Fail):
    """Stands in for the runner's `ctx.CallError`."""

    def __init__(self, code: str, message: str, remedy: str = "", retryable: bool = False) -> None:
        super().__init__(message, remedy, retryable)
        self.code = code


class Moved(BaseException):
    """A run is left where it is: its next attempt is made elsewhere."""


class FakeContext:
    """A `ctx` whose robot goes where it is sent at once and photographs what the test has drawn."""

    Fail = Fail
    CallError = CallError

    def __init__(self, scratch: Path, **params: Any) -> None:
        self.params: dict[str, Any] = params
        self.robot: str | None = "robot_1"
        self.robots: tuple[str, ...] = ("robot_1",)
        self.poses: dict[str, dict[str, float]] = {}
        self.inputs: dict[str, dict[str, Any]] = {}
        self.attempt = 1
        self.site: dict[str, Any] = msgspec.to_builtins(load_site("warehouse"))
        self.scratch = scratch
        self.info: dict[str, Any] = {
            "id": "robot_1",
            "kind": "zenoh",
            "verbs": ["state", "goto", "pick", "place", "capture", "record", "hold"],
            "pose": {"x": 4.0, "y": 4.0},
        }
        self.picture = draw()
        self.commands: list[tuple[str, dict[str, Any]]] = []
        self.notices: list[tuple[str, str]] = []
        self.questions: list[tuple[str, str]] = []
        self.said = "yes"
        self.files: dict[str, bytes] = {}
        self.steps: list[tuple[float, str]] = []
        self.logged: list[str] = []
        self.partials: list[dict[str, Any]] = []
        self.checkpoints: list[dict[str, Any]] = []
        self.interrupt_after = 0
        self.resume: dict[str, Any] | None = None
        self.answers: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {}

    def command(self, verb: str, timeout_s: float = 60, **args: Any) -> dict[str, Any]:
        """Note the command and answer it: the test's own answer first, else a robot that does everything at once."""
        assert timeout_s > 0
        msgspec.json.encode(args)  # what is sent must be JSON
        self.commands.append((verb, args))
        if verb in self.answers:
            return self.answers[verb](args)
        match verb:
            case "state":
                return dict(self.info)
            case "goto":
                self.info["pose"] = dict(args["waypoints"][-1])
                return {"pose": dict(args["waypoints"][-1])}
            case "capture":
                return {"blobs": {"image.png": self.picture}, "width": 320}
            case "record":
                count = round(args["duration_s"] * args["fps"])
                return {"blobs": {f"frame-{number:03d}.jpg": draw(kind="JPEG") for number in range(count)}}
            case _:
                return {"did": verb}

    def command_all(
        self, verb: str, robots: dict[str, dict[str, Any]], timeout_s: float = 60
    ) -> dict[str, dict[str, Any]]:
        """Note the command and have each robot do it at once, from where the test has put it (`poses`)."""
        assert timeout_s > 0
        assert set(robots) <= set(self.robots)
        self.commands.append((verb, msgspec.json.decode(msgspec.json.encode(robots))))
        if verb == "goto":
            self.poses |= {robot: dict(args["waypoints"][-1]) for robot, args in robots.items()}
        return {robot: dict(self.info) | {"pose": self.poses.get(robot)} for robot in robots}

    def notify(self, to: str, text: str) -> dict[str, Any]:
        """Note the notice."""
        self.notices.append((to, text))
        return {"notice": f"t1/s1/{len(self.notices)}"}

    def volume(self, name: str) -> Path:
        """Return a folder that outlives the run."""
        folder = self.scratch / "volumes" / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def host_folder(self, name: str) -> Path:
        """Return a folder of the machine."""
        return self.scratch / "folders" / name

    def ask(self, question: str, choices: Sequence[str] = (), to: str = "operator", timeout_s: float = 240) -> str:
        """Note the question, and answer as the test says."""
        assert timeout_s > 0
        self.questions.append((to, question))
        assert not choices or self.said in choices
        return self.said

    def put_artifact(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> dict[str, Any]:
        """Keep the file in memory."""
        digest = hashlib.sha256(data).hexdigest()
        self.files[digest] = data
        return {"artifact": digest, "name": name, "media_type": media_type, "bytes": len(data), "gateway": "gw1"}

    def get_artifact(self, ref: dict[str, Any]) -> bytes:
        """Return a kept file."""
        return self.files[ref["artifact"]]

    def progress(self, fraction: float, note: str = "") -> None:
        """Note the step; a fraction outside 0 to 1 is a handler's mistake."""
        assert 0.0 <= fraction <= 1.0
        self.steps.append((fraction, note))

    def log(self, text: str, **fields: Any) -> None:  # noqa: ARG002 - the runner's signature
        """Note the line."""
        self.logged.append(text)

    def partial(self, result: dict[str, Any]) -> None:
        """Note the partial result."""
        self.partials.append(result)

    def checkpoint(self, data: dict[str, Any]) -> None:
        """Note the checkpoint as a later attempt gets it; `interrupt` ends the run there, as a move does."""
        self.checkpoints.append(msgspec.json.decode(msgspec.json.encode(data)))
        if self.interrupt_after == len(self.checkpoints):
            raise Moved

    def checkpoint_due(self) -> bool:
        """Whether one is wanted: always, so that handlers that ask are tested too."""
        return True

    def sent(self, verb: str) -> list[dict[str, Any]]:
        """Return the arguments of every command of that verb."""
        return [args for name, args in self.commands if name == verb]


def draw(
    *things: tuple[str, tuple[int, int, int, int]], size: tuple[int, int] = (320, 240), kind: str = "PNG"
) -> bytes:
    """Draw a picture as the simulated camera does: sky, floor, grey shelves, and coloured boxes (left, top, w, h)."""
    picture = Image.new("RGB", size, (142, 122, 101))
    pen = ImageDraw.Draw(picture)
    pen.rectangle((0, 0, size[0], size[1] * 2 // 5), fill=(150, 190, 225))
    pen.rectangle((size[0] - 60, 40, size[0] - 20, 140), fill=(128, 130, 132))
    for colour, (left, top, width, height) in things:
        pen.rectangle((left, top, left + width - 1, top + height - 1), fill=colour)
    out = io.BytesIO()
    picture.save(out, kind)
    return out.getvalue()


@pytest.fixture
def make_ctx(tmp_path: Path) -> Callable[..., FakeContext]:
    """Return a function that makes a ctx with these parameters."""

    def make(**params: Any) -> FakeContext:
        return FakeContext(tmp_path, **params)

    return make


@pytest.fixture
def picture() -> Callable[..., bytes]:
    """Return the function that draws a picture."""
    return draw


@pytest.fixture
def handler(monkeypatch: pytest.MonkeyPatch) -> Callable[..., ModuleType]:
    """Return a function that loads a skill's handler the way the runner does, with the skills folder on the path."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(SKILLS)])

    def load(skill: str, folder: Path | None = None) -> ModuleType:
        file = (folder or SKILLS / skill) / "handler.py"
        spec = importlib.util.spec_from_file_location(f"skill_{skill}", file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture
def leave() -> Callable[..., dict[str, Any]]:
    """Return a function that runs a handler until its checkpoint of that number, and returns what the next one gets."""

    def run_until(run: Callable[[Any], Any], ctx: FakeContext, after: int) -> dict[str, Any]:
        ctx.interrupt_after = after
        with pytest.raises(Moved):
            run(ctx)
        return ctx.checkpoints[-1]

    return run_until
