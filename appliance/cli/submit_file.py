"""`swiftbot submit --file`: the tasks of a file of JSON lines, handed in in its order."""

import asyncio
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance import console
from appliance.cli.common import Where, show
from appliance.client import FleetClient
from appliance.connection import operator_name
from appliance.errors import ConfigError, Exit, SwiftbotError, UnreachableError
from appliance.model import TaskRecord, TaskRequest
from appliance.submission import Pace, submit_all

MOST_LINE = 1 << 20
"""Bytes of a line; a task has a plan of at most 64 subtasks."""
CANCELS_AT_ONCE = 8


class Problem(Struct, frozen=True):
    """A line that is no task, or that was not taken."""

    line: int
    id: str
    problem: str


class Summary(Struct, frozen=True, kw_only=True):
    """What became of a file."""

    file: str
    id: str
    """What the ids of its tasks begin with, where the file gives none: `ID-LINE`."""
    accepted: int
    problems: tuple[Problem, ...]
    cancelled: int = 0


class Lines:
    """The requests in a file; lines that are none are told and kept in `problems`."""

    def __init__(self, path: Path, base: TaskRequest) -> None:
        self.problems: list[Problem] = []
        self.line_of: dict[str, int] = {}
        self._path = path
        self._base = base

    def __iter__(self) -> Iterator[TaskRequest]:
        """Read line by line; ConfigError where the file cannot be read."""
        try:
            with self._path.open("rb") as file:
                for number, line in enumerate(iter(lambda: file.readline(MOST_LINE + 1), b""), start=1):
                    if (request := self._request(number, line)) is not None:
                        yield request
        except OSError as error:
            raise ConfigError(
                f"{self._path} cannot be read: {error.strerror}", remedy="give a file of JSON lines"
            ) from error

    def _request(self, number: int, line: bytes) -> TaskRequest | None:
        if not line.strip():
            return None
        if len(line) > MOST_LINE:
            raise ConfigError(
                f"{self._path}:{number}: the line has over {MOST_LINE:,} bytes", remedy="one task a line, as JSON"
            )
        try:
            value: Any = msgspec.json.decode(line)
            fields = {"instruction": value} if isinstance(value, str) else value
            if not isinstance(fields, dict):
                raise msgspec.ValidationError("neither an instruction nor an object")
            given = msgspec.convert(fields, TaskRequest)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            self.add(number, "", f"no task: {error}")
            return None
        # What the line does not say is as the command says it.
        said = {name: getattr(given, name) for name in TaskRequest.__struct_fields__ if name in fields}
        said = {"id": f"{self._base.id}-{number}"} | said | {"submitter": self._base.submitter}
        request = replace(self._base, **said)
        if request.id in self.line_of:
            self.add(number, request.id, f"line {self.line_of[request.id]} has the same id")
            return None
        self.line_of[request.id] = number
        return request

    def add(self, number: int, task: str, problem: str) -> None:
        """Note and tell what is wrong with a line."""
        self.problems.append(Problem(number, task, problem))
        console.err.print(f"{self._path}:{number}: {problem}", markup=False, soft_wrap=True)


def submit_file(path: Path, request: TaskRequest, where: Where, *, as_json: bool) -> int:
    """Hand in the tasks of a file; `request` says what its lines do not say.

    Exit code 1: some lines were not taken. Ctrl-C hands in no more; on a terminal it is asked whether those that were
    accepted are cancelled.

    Raises:
        ConfigError: the file cannot be read.
        UnreachableError, DeadlineError: the fleet does not answer any more.
    """
    base = replace(request, id=request.id or f"f-{uuid.uuid4().hex[:8]}", submitter=operator_name())
    lines = Lines(path, base)
    accepted: list[str] = []
    cancelled, ended = 0, True
    try:
        asyncio.run(_hand_in(lines, where, accepted))
    except KeyboardInterrupt:
        ended = False
        if accepted and _wants_cancel(len(accepted)):
            cancelled = asyncio.run(_cancel(accepted, where))
    except SwiftbotError:
        _tell_rest(path, base.id, len(accepted))
        raise
    if not ended and not cancelled:
        _tell_rest(path, base.id, len(accepted))
    found = Summary(
        file=str(path), id=base.id, accepted=len(accepted), problems=tuple(lines.problems), cancelled=cancelled,
    )  # fmt: skip
    wrong = f"; {len(found.problems):,} lines were not taken" if found.problems else ""
    show(found, as_json=as_json, table=f"{found.accepted:,} tasks of {path} are accepted{wrong}")
    if not ended:
        return Exit.INTERRUPTED
    return Exit.FAILED if found.problems else Exit.DONE


async def _hand_in(lines: Lines, where: Where, accepted: list[str]) -> None:
    pace = Pace()
    async with where.client() as client:
        with console.err.status("submitting") as status:
            async for request, outcome in submit_all(client, lines, pace=pace):
                if isinstance(outcome, TaskRecord):
                    accepted.append(request.id)
                else:
                    lines.add(lines.line_of[request.id], request.id, str(outcome))
                waits = f"; waiting: {pace.waits}" if pace.until > asyncio.get_running_loop().time() else ""
                status.update(f"{len(accepted):,} tasks accepted{waits}")


def _tell_rest(path: Path, base: str, accepted: int) -> None:
    console.err.print(
        f"{accepted:,} tasks are accepted and go on; `swiftbot submit --file {path} --id {base}` hands in the rest and "
        "begins none twice",
        markup=False, soft_wrap=True,
    )  # fmt: skip


def _wants_cancel(count: int) -> bool:
    """Ask whether accepted tasks are cancelled; no where nobody can be asked."""
    if not console.err.is_terminal:
        return False
    try:
        said = console.err.input(f"\n{count:,} tasks are accepted: [K]eep or [c]ancel them? ", markup=False)
    except (EOFError, KeyboardInterrupt):
        console.err.print()
        return False
    return said.strip().casefold() in ("c", "cancel")


async def _cancel(tasks: list[str], where: Where) -> int:
    """Cancel tasks, the last one first: those that have not begun; returns how many."""
    left, done = list(tasks), 0
    async with where.client() as client:

        async def some() -> None:
            nonlocal done
            while left:
                done += await _cancelled(client, left.pop())
                status.update(f"{done:,} of {len(tasks):,} tasks are cancelled")

        with console.err.status("cancelling") as status:
            await asyncio.gather(*(some() for _ in range(CANCELS_AT_ONCE)))
    return done


async def _cancelled(client: FleetClient, task: str) -> bool:
    try:
        await client.cancel(task, why="the file that it came in was called off")
    except UnreachableError:
        raise
    except SwiftbotError as error:
        console.err.print(f"task {task} may go on: {error}", markup=False)
        return False
    return True
