"""A real terminal for tests: tmux, with keys in and the screen out."""

import asyncio
import contextlib
import os
import shlex
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

ANSWER_S = 30.0


class Terminal:
    """A tmux server of its own with one window, which ends with the program in it.

    Args:
        folder: for its socket.
        size: columns and lines.
    """

    def __init__(self, folder: Path, size: tuple[int, int] = (80, 24)) -> None:
        self._socket = folder / "tmux.sock"
        self._size = size
        self._status = folder / "status"

    async def start(self, command: Sequence[str], environment: dict[str, str]) -> None:
        """Start a program in it."""
        assert shutil.which("tmux"), "tmux is not installed: scripts/setup.sh dev brings it"
        pairs = [word for name, value in environment.items() for word in ("-e", f"{name}={value}")]
        columns, lines = self._size
        line = f"{shlex.join(command)}; echo $? > {shlex.quote(str(self._status))}"
        await self._tmux(
            "-f",
            "/dev/null",
            "new-session",
            "-d",
            "-x",
            str(columns),
            "-y",
            str(lines),
            *pairs,
            f"sh -c {shlex.quote(line)}",
        )

    async def press(self, *keys: str) -> None:
        """Press keys by tmux's names (`Enter`, `Escape`, `F2`, `Down`)."""
        for key in keys:
            await self._tmux("send-keys", key)

    async def write(self, text: str) -> None:
        """Type a text."""
        await self._tmux("send-keys", "-l", text)

    async def screen(self) -> str:
        """Return what is on the screen; empty when the program has ended."""
        try:
            return await self._tmux("capture-pane", "-p")
        except RuntimeError:
            return ""

    async def see(self, *wanted: str, without: Sequence[str] = (), timeout_s: float = 60.0) -> str:
        """Wait until all of some texts are on the screen; fails with what is there instead."""
        give_up = time.monotonic() + timeout_s
        while True:
            text = await self.screen()
            if all(each in text for each in wanted) and not any(each in text for each in without):
                return text
            if time.monotonic() > give_up:
                raise AssertionError(f"the screen does not show {wanted} (without {tuple(without)}):\n{text}")
            await asyncio.sleep(0.1)

    async def ended(self, timeout_s: float = 30.0) -> int:
        """Wait for the program's end; its exit status."""
        async with asyncio.timeout(timeout_s):
            while not (self._status.exists() and self._status.read_text().strip()):
                await asyncio.sleep(0.1)
        return int(self._status.read_text())

    async def close(self) -> None:
        """End all of it."""
        with contextlib.suppress(RuntimeError):
            await self._tmux("kill-server")

    async def _tmux(self, *arguments: str) -> str:
        # Files, no pipes: a server that this call starts may keep its ends open, and then nothing would end the wait.
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as problem:
            process = await asyncio.create_subprocess_exec(
                "tmux", "-u", "-S", str(self._socket), *arguments,
                stdin=asyncio.subprocess.DEVNULL, stdout=out, stderr=problem, env=os.environ | {"LC_ALL": "C.UTF-8"},
            )  # fmt: skip
            try:
                async with asyncio.timeout(ANSWER_S):
                    await process.wait()
            except TimeoutError:
                process.kill()
                await process.wait()
                raise RuntimeError(f"tmux {arguments[0]} does not answer") from None
            out.seek(0)
            problem.seek(0)
            if process.returncode:
                raise RuntimeError(problem.read().decode(errors="replace").strip())
            return out.read().decode(errors="replace")
