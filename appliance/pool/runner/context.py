"""`ctx`: everything a skill handler can ask of the appliance.

Each method that needs an answer is one frame out and one frame in on the run's own connection, so a handler is
plain blocking code and needs nothing installed. Calls are numbered in the order they are made; the number is
part of the effect's identity, so a handler that makes the same calls again in a later attempt doubles nothing.
"""

import mmap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from .frames import beyond, encode, size_of
from .link import LARGE, CallError, Cancelled, Fail, Frame, Link
from .spec import Skill, Spec

MAX_ARTIFACT = 11 * 2**20
"""Longest file in bytes that is kept as an artifact: as base64 it fits into one frame."""
MAX_NEWS = 2**20
"""Longest partial result in bytes of JSON: it is news for listeners."""
MAX_CHECKPOINT = 2**18
"""Longest checkpoint in bytes of JSON: it is kept on several gateways and travels with the next attempt's order."""


class Surroundings:
    """What a handler finds around it, before any run and in each.

    Attributes:
        site: The site's map, as a plain dict.
        folder: The skill's own folder, read-only.
    """

    Fail = Fail

    def __init__(self, skill: Skill, spec: Spec) -> None:
        self.site: dict[str, Any] = spec.site
        self.folder = skill.folder
        self._volumes = spec.volumes
        self._folders = spec.folders

    def volume(self, name: str) -> Path:
        """Return the folder of a named volume.

        Raises:
            Fail: it is not mounted here.
        """
        path = self._volumes / name
        if path.parent != self._volumes or not path.is_dir():
            raise Fail(f"there is no volume {name!r} here", "name it in `volumes` of the skill's manifest")
        return path

    def host_folder(self, name: str) -> Path:
        """Return a folder of the gateway's machine, which can be read only.

        Raises:
            Fail: it is not mounted here.
        """
        path = self._folders / name
        if path.parent != self._folders or not path.is_dir():
            raise Fail(
                f"the folder {name!r} is not mounted here",
                f"name it in `folders` of the skill's manifest, and see that pool.folders.{name} is there",
            )
        return path

    def map(self, path: str | Path) -> mmap.mmap:
        """Return a file's bytes without reading them: shared by all containers, and free at a fork.

        Args:
            path: a file, relative to the skill's folder or absolute (in a volume). It must not change meanwhile.

        Raises:
            OSError, ValueError: it is not there, or empty.
        """
        with (self.folder / path).open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


class Context(Surroundings):
    """What a handler's `run(ctx)` gets.

    Attributes:
        params: The subtask's parameters.
        robot: The robot it is bound to, or None.
        robots: All its robots, more than one in a joint skill.
        inputs: Results of the subtasks it comes after, by subtask id.
        attempt: 1 for the first try.
        resume: The last checkpoint of the attempts before, or None.
        preloaded: What the handler's `preload` returned, or None.
        scratch: A folder of this run alone, gone afterwards.
        cache: A folder that all containers of the image on this gateway share, for what can be worked out again; it may
            be emptied at any time. `scratch` where the manifest asks for none.
        max_result_bytes: Longest result, bytes of JSON; what is larger belongs into a volume or an artifact.
    """

    CallError = CallError
    Cancelled = Cancelled

    def __init__(self, link: Link, order: Frame, *, skill: Skill, spec: Spec, preloaded: Any, scratch: Path) -> None:
        super().__init__(skill, spec)
        self._link = link
        self.params: dict[str, Any] = order.get("params") or {}
        self.robot: str | None = order.get("robot")
        self.robots: tuple[str, ...] = (self.robot, *(order.get("others") or ())) if self.robot else ()
        self.inputs: dict[str, dict[str, Any]] = order.get("inputs") or {}
        self.attempt: int = int(order.get("attempt", 1))
        self.resume: dict[str, Any] | None = order.get("resume")
        if self.resume is not None:
            link.go_on_from(int(order.get("calls") or 0))
        self.preloaded = preloaded
        self.scratch = scratch
        self.cache = spec.cache or scratch
        self.max_result_bytes = spec.max_result_bytes

    def command(self, verb: str, timeout_s: float = 60, **args: Any) -> dict[str, Any]:
        """Have the robot do `verb` and return its answer; files come as bytes in `answer["blobs"][name]`.

        Raises:
            CallError: the robot did not, with the reason.
        """
        return self._dict(self._link.ask("command", {"verb": verb, "timeout_s": timeout_s, "args": args}))

    def command_all(
        self, verb: str, robots: dict[str, dict[str, Any]], timeout_s: float = 60
    ) -> dict[str, dict[str, Any]]:
        """Have several of its robots do `verb` at the same time, each with its arguments; returns their answers.

        None is sent before all can be commanded; when one fails, is lost or stopped, the others hold.

        Raises:
            CallError: one of them did not, with the reason and what became of the others.
        """
        answers = self._link.ask("command_all", {"verb": verb, "timeout_s": timeout_s, "robots": robots})
        return {robot: self._dict(answer) for robot, answer in self._dict(answers).items()}

    def notify(self, to: str, text: str) -> dict[str, Any]:
        """Send a message to a person."""
        return self._dict(self._link.ask("notify", {"to": to, "text": text}))

    def ask(self, question: str, choices: Sequence[str] = (), to: str = "operator", timeout_s: float = 240) -> str:
        """Ask people and return the answer, one of `choices` where there are any; the first answer counts.

        Raises Fail when nobody answers within `timeout_s`.
        """
        args = {"question": question, "choices": list(choices), "to": to, "timeout_s": timeout_s}
        return str(self._dict(self._link.ask("ask", args)).get("answer", ""))

    def request(self, name: str, **args: Any) -> dict[str, Any]:
        """Ask a part of the gateway that offers something to skills that come with it; CallError where there is none.

        `masks` {epoch}: of a client with secure aggregation.
        """
        return self._dict(self._link.ask(name, args))

    def put_artifact(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> dict[str, Any]:
        """Keep a file and return a reference to it, fit for a result; CallError when it is longer than 11 MiB."""
        if len(data) > MAX_ARTIFACT:
            text = f"the file {name[:80]!r} has {len(data):,} bytes, at most {MAX_ARTIFACT:,} (11 MiB) are possible"
            raise CallError("payload", text, "write it into a volume of the skill, or in parts")
        args = {"name": name, "data": bytes(data), "media_type": media_type}
        return self._dict(self._link.ask("put_artifact", args))

    def get_artifact(self, ref: dict[str, Any]) -> bytes:
        """Return the bytes of a file that a result refers to, from whichever gateway has it."""
        data: Any = self._dict(self._link.ask("get_artifact", {"ref": ref})).get("data", b"")
        return data if isinstance(data, bytes) else b""

    def progress(self, fraction: float, note: str = "") -> None:
        """Tell how far it is, 0 to 1, and what it does."""
        self._link.send({"ev": "progress", "fraction": min(1.0, max(0.0, float(fraction))), "note": str(note)[:500]})

    def log(self, text: str, **fields: Any) -> None:
        """Write a line to the fleet's log."""
        self._link.send({"ev": "log", "text": str(text)[:4000], "fields": fields})

    def alive(self) -> None:
        """Give a sign of life and nothing more, now and then in a long computation; it costs next to nothing."""
        self._link.send({"ev": "alive"})

    def partial(self, result: dict[str, Any]) -> None:
        """Publish what is known so far of the result; CallError when it is longer than 1 MiB of JSON."""
        self._tell("partial", "result", result, MAX_NEWS)

    def checkpoint(self, data: dict[str, Any]) -> None:
        """Keep data from which a later attempt could go on (`ctx.resume`); CallError beyond 256 KiB of JSON.

        The number of calls made so far is kept with it: an attempt that goes on from here makes only those that come
        after, and they must keep their numbers, by which an effect that was done already is known.
        """
        self._link.saving_asked = False
        self._tell("checkpoint", "data", data, MAX_CHECKPOINT, calls=self._link.calls)

    def checkpoint_due(self) -> bool:
        """Whether the appliance wants a checkpoint now, because it is about to move the run to another gateway.

        A handler whose checkpoints cost something asks this between two steps, and saves when the answer is yes. It has
        a second or two; a run that saves nothing by then goes on elsewhere from its last checkpoint.
        """
        return self._link.saving_asked

    def _tell(self, kind: str, key: str, value: dict[str, Any], most: int, **more: int) -> None:
        if not isinstance(value, dict):  # pyright: ignore[reportUnnecessaryIsInstance] - handlers are not checked
            raise CallError("payload", f"a {kind} is a dict, not {type(value).__name__}")
        frame = {"ev": kind, key: value, **more}
        if (size := size_of(frame)) > most:
            raise CallError("payload", beyond(f"a {kind}", size, most), LARGE)
        self._link.send_encoded(encode(frame))

    @staticmethod
    def _dict(value: Any) -> dict[str, Any]:
        return cast("dict[str, Any]", value) if isinstance(value, dict) else {}
