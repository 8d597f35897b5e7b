"""Runs programs of the machine, as root or as the service user."""

import asyncio
import contextlib
import os
import pwd
from pathlib import Path

from appliance.errors import PrerequisiteError, RefusedError

USER = "swiftbot"


async def command(
    *words: str,
    as_user: bool = False,
    timeout_s: float = 60.0,
    codes: tuple[int, ...] = (0,),
    folder: Path | None = None,
    data: Path | None = None,
    out: Path | None = None,
) -> str:
    """Run a program and return what it printed.

    Args:
        words: program and arguments.
        as_user: as the service user, where this is root and there is such a user.
        timeout_s: it is ended then.
        codes: exit codes that are none of an error.
        folder: where it runs.
        data: file that is its standard input.
        out: file that gets what it prints, instead of being returned.

    Raises:
        PrerequisiteError: it is not installed.
        RefusedError: it fails, or does not end; with the end of what it said.
    """
    entry = _service_user() if as_user else None
    become = (
        ("setpriv", f"--reuid={entry.pw_uid}", f"--regid={entry.pw_gid}", "--init-groups", "--inh-caps=-all", "--")
        if entry is not None
        else ()
    )
    with contextlib.ExitStack() as stack:
        try:
            process = await asyncio.create_subprocess_exec(
                *become,
                *words,
                stdin=asyncio.subprocess.DEVNULL if data is None else stack.enter_context(data.open("rb")),
                stdout=asyncio.subprocess.PIPE if out is None else stack.enter_context(out.open("wb")),
                stderr=asyncio.subprocess.PIPE,
                cwd=folder or "/",
                env=_environment(entry),
            )
        except OSError as error:
            raise PrerequisiteError(f"{words[0]} cannot be run: {error.strerror}", remedy="swiftbot doctor") from error
    try:
        async with asyncio.timeout(timeout_s):
            printed, told = await process.communicate()
    except TimeoutError:
        raise RefusedError(f"{' '.join(words[:3])} did not end within {timeout_s:g} s") from None
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode not in codes:
        said = ((printed or b"") + (told or b"")).decode(errors="replace").strip()[-500:]
        raise RefusedError(f"{' '.join(words[:3])} ended with {process.returncode}: {said}")
    return (printed or b"").decode(errors="replace")


def _service_user() -> pwd.struct_passwd | None:
    """Return the user to become; None where this is not root, or there is no such user."""
    if os.getuid() != 0:
        return None
    try:
        return pwd.getpwnam(USER)
    except KeyError:
        return None


def _environment(user: pwd.struct_passwd | None) -> dict[str, str]:
    kept = {"PATH": os.environ.get("PATH", "/usr/sbin:/usr/bin:/sbin:/bin"), "LANG": "C.UTF-8"}
    if user is not None:
        return kept | {"HOME": user.pw_dir, "USER": user.pw_name, "XDG_RUNTIME_DIR": f"/run/user/{user.pw_uid}"}
    return kept | {name: os.environ[name] for name in ("HOME", "XDG_RUNTIME_DIR") if name in os.environ}
