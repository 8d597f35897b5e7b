"""Tiny data sets in both layouts, made by the real generators."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from appliance.learn.datasets.make import Clips, Speech, make_clips, make_speech
from appliance.learn.datasets.speech import Speaker

CLIPS = Clips(train_sites=3, test_sites=2, train_clips=1, test_clips=1)


def hum(who: Speaker, text: str) -> NDArray[np.float32]:
    """Stand in for the program that speaks: a tone for each letter, as high as the speaker's voice."""
    times = np.arange(800, dtype=np.float32) / 16_000
    return np.concatenate([np.sin(times * (100 + who.pitch + 10 * ord(letter))) for letter in text]).astype(np.float32)


@pytest.fixture(scope="module")
def made_clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of clips that tests only read: 30 for training, 20 for testing."""
    folder = tmp_path_factory.mktemp("clips") / "clips"
    make_clips(folder, CLIPS)
    return folder


@pytest.fixture
def clips(tmp_path: Path, made_clips: Path) -> Path:
    """Return a folder of clips of the test's own."""
    import shutil  # noqa: PLC0415 - only here

    return Path(shutil.copytree(made_clips, tmp_path / "clips"))


@pytest.fixture
def make_words(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes recordings of words: 4 speakers for training, 2 for testing, 6 words each."""

    def make(**more: int) -> Path:
        folder = tmp_path / "words"
        sizes = {"train_speakers": 4, "test_speakers": 2, "recordings": 6} | more
        make_speech(folder, Speech(kind="words", **sizes), synthesise=hum)
        return folder

    return make
