"""The model's process where the machine has nothing left for it: a clear error, and another try."""

import asyncio
import errno
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import IdentityError, PrerequisiteError, UnreachableError
from appliance.llm import local as module
from appliance.llm.local import ModelProcess
from appliance.llm.settings import LlmConfig

pytestmark = pytest.mark.anyio


@pytest.fixture
def folder(tmp_path: Path) -> str:
    """Return a folder that could be a model's."""
    (tmp_path / "genai_config.json").write_text("{}")
    return str(tmp_path)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_PAUSES_S", (0.01,))


@pytest.mark.parametrize("number", [errno.ENOMEM, errno.EMFILE, errno.EAGAIN])
async def test_a_process_that_cannot_be_started_is_said_and_tried_again(
    number: int, folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A request meanwhile gets the machine's own words and what to look at, and does not wait."""
    tries: list[int] = []

    async def start(*_: Any, **__: Any) -> Any:
        tries.append(number)
        raise OSError(number, "nothing left")

    monkeypatch.setattr(asyncio, "create_subprocess_exec", start)
    model = ModelProcess(folder, LlmConfig())
    await model.start()
    try:
        for _ in range(2):
            async with asyncio.timeout(60):
                with pytest.raises(UnreachableError, match=r"cannot be started: .*nothing left") as caught:
                    await model.ready()
            assert "open files" in caught.value.remedy
            with pytest.raises(UnreachableError, match="not running"):
                await model.exchange({})
        async with asyncio.timeout(60):
            while len(tries) < 3:
                await asyncio.sleep(0.005)
        assert model.restarts >= 2
        assert model.pid is None
    finally:
        await model.close()


async def test_a_program_that_is_not_there_is_said(folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The real thing: what the system answers to the start of a file that does not exist."""
    monkeypatch.setattr(module.sys, "executable", f"{folder}/python")
    model = ModelProcess(folder, LlmConfig())
    await model.start()
    try:
        async with asyncio.timeout(60):
            with pytest.raises(UnreachableError, match=r"cannot be started: .*No such file"):
                await model.ready()
    finally:
        await model.close()


async def test_a_folder_that_is_no_models_is_said_at_once(tmp_path: Path) -> None:
    """Before any process is started; the keeper ends all the same."""
    model = ModelProcess(str(tmp_path), LlmConfig())
    with pytest.raises(PrerequisiteError, match=r"genai_config\.json is missing"):
        await model.start()
    await model.close()


async def test_a_folder_that_is_not_signed_is_not_loaded(folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """No process is started, whoever asks hears why, and it is looked at again before each try."""
    looked: list[Path] = []

    def refuse(path: Path) -> None:
        looked.append(path)
        raise IdentityError("model m is not signed", remedy="sign it")

    async def start(*_: Any, **__: Any) -> Any:
        pytest.fail("started")

    monkeypatch.setattr(asyncio, "create_subprocess_exec", start)
    model = ModelProcess(folder, LlmConfig(), refuse)
    await model.start()
    try:
        async with asyncio.timeout(60):
            with pytest.raises(IdentityError, match="is not signed"):
                await model.ready()
            while len(looked) < 3:
                await asyncio.sleep(0.005)
        assert set(looked) == {Path(folder)}
    finally:
        await model.close()


@pytest.mark.parametrize("broken", [OSError(errno.EIO, "Input/output error"), RuntimeError("the handler is closed")])
async def test_a_pipe_that_breaks_is_an_error_of_the_model(broken: Exception, folder: str) -> None:
    """Whatever the system says of the pipe, the asker hears that the model cannot be asked."""

    class Pipe:
        def write(self, _: bytes) -> None:
            raise broken

    class Process:
        stdin = Pipe()

    model = ModelProcess(folder, LlmConfig())
    model._process = Process()  # type: ignore[assignment]
    with pytest.raises(UnreachableError, match="the local model cannot be asked"):
        await model.exchange({})
