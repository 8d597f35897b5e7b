"""Writes stand-ins into a folder, laid out as UCF101 and LibriSpeech are.

Each file is written in one step, so one that is there is whole: begun again with the same settings it goes on where it
was, and does nothing where all is there. The lists that make a folder a data set are written last. All follows from the
seed: the same arguments make the same files on every gateway.
"""

import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct

from appliance.errors import PayloadError
from appliance.learn.datasets import clips, speech
from appliance.learn.datasets.avi import write_avi
from appliance.learn.datasets.flac import write_flac
from appliance.learn.datasets.speech import Synthesise
from appliance.skills._lib.learning import librispeech, ucf101
from appliance.skills._lib.learning.sounds import RATE

Progress = Callable[[int, int], None]
"""Told how many files are there, and of how many."""
SETTINGS = "standin.json"
"""What a folder was made with."""


class Clips(Struct, frozen=True, kw_only=True):
    """A stand-in for UCF101; sites are groups, those for testing come first."""

    kind: str = "clips"
    seed: int = 1
    train_sites: int = 24
    test_sites: int = 8
    train_clips: int = 8
    """Of each class on each site."""
    test_clips: int = 12


class Speech(Struct, frozen=True, kw_only=True):
    """A stand-in for LibriSpeech: `words` has one word a recording, `sentences` an order to a robot."""

    kind: str
    seed: int = 1
    train_speakers: int = 32
    test_speakers: int = 8
    recordings: int = 60
    """Of each speaker."""


def _nobody(done: int, total: int) -> None:
    del done, total


def is_whole(folder: Path) -> bool:
    """Whether a folder is a data set, and no stand-in whose making was interrupted: its lists are written last."""
    if not (folder / SETTINGS).is_file():
        return folder.is_dir()
    lists = (folder / ucf101.LISTS / "testlist01.txt", folder / librispeech.HOME / "SPEAKERS.TXT")
    return any(file.is_file() for file in lists)


def make_clips(folder: Path, settings: Clips | None = None, *, progress: Progress = _nobody) -> int:
    """Write action clips; returns how many files are there.

    Raises:
        PayloadError: the folder holds something else.
        OSError: it cannot be written.
    """
    wanted = settings or Clips()
    _claim(folder, wanted)
    lists: dict[str, list[str]] = {"train": [], "test": []}
    jobs = list(_clips(wanted))
    for done, (split, group, name, number) in enumerate(jobs, start=1):
        path = f"{name}/v_{name}_g{group:02d}_c{number:02d}.avi"
        file = folder / ucf101.VIDEOS / path
        label = f" {clips.CLASSES.index(name) + 1}" if split == "train" else ""
        lists[split].append(path + label)
        if not file.exists():
            pictures = clips.clip(clips.site(wanted.seed, group), name, wanted.seed, group, number)
            _write(file, write_avi(pictures, width=clips.WIDTH, height=clips.HEIGHT, fps=clips.FPS))
        progress(done, len(jobs))
    classes = "".join(f"{number} {name}\n" for number, name in enumerate(clips.CLASSES, start=1))
    _write(folder / ucf101.LISTS / "classInd.txt", classes.encode())
    for split, lines in lists.items():
        _write(folder / ucf101.LISTS / f"{split}list01.txt", "".join(f"{line}\n" for line in lines).encode())
    return len(jobs)


def _clips(wanted: Clips) -> Iterator[tuple[str, int, str, int]]:
    """Yield split, group, class and number of each clip."""
    for group in range(1, wanted.test_sites + wanted.train_sites + 1):
        split = "test" if group <= wanted.test_sites else "train"
        for name in clips.CLASSES:
            for number in range(1, (wanted.test_clips if split == "test" else wanted.train_clips) + 1):
                yield split, group, name, number


def make_speech(
    folder: Path, settings: Speech, *, synthesise: Synthesise = speech.espeak, progress: Progress = _nobody
) -> int:
    """Write recordings of words or sentences; returns how many files are there.

    Args:
        folder: where to; `LibriSpeech` is made in it.
        settings: what, and how much.
        synthesise: says a text.
        progress: told each file.

    Raises:
        PayloadError: the folder holds something else, or there is no such kind.
        PrerequisiteError: there is nothing to make speech with.
        OSError: the folder cannot be written.
    """
    if settings.kind not in ("words", "sentences"):
        raise PayloadError(f"no stand-in {settings.kind[:40]!r}", remedy="clips, words or sentences")
    _claim(folder, settings)
    home = folder / librispeech.HOME
    total = (settings.train_speakers + settings.test_speakers) * settings.recordings
    done = 0
    people: list[str] = []
    for number in range(1, settings.train_speakers + settings.test_speakers + 1):
        who = speech.speaker(settings.seed, number)
        subset = "train-synthetic" if number <= settings.train_speakers else "test-synthetic"
        people.append(f"{number:<4} | {who.sex} | {subset:<15} | 0.00  | {who.accent} {who.voice}")
        done = _speak(home / subset / str(number) / "1", who, settings, synthesise, progress, done, total)
    head = ";ID  |SEX| SUBSET           |MINUTES| NAME\n"
    _write(home / "SPEAKERS.TXT", (head + "\n".join(people) + "\n").encode())
    return done


def _speak(
    chapter: Path,
    who: speech.Speaker,
    settings: Speech,
    synthesise: Synthesise,
    progress: Progress,
    done: int,
    total: int,
) -> int:
    said = speech.words if settings.kind == "words" else speech.sentences
    texts = said(settings.seed * 100_003 + who.number)
    lines: list[str] = []
    for number in range(settings.recordings):
        name, text = f"{who.number}-1-{number:04d}", next(texts)
        lines.append(f"{name} {text}\n")
        file = chapter / f"{name}.flac"
        if not file.exists():
            rng = np.random.Generator(np.random.Philox([settings.seed, who.number, number]))
            # Nobody says a thing twice alike.
            varied = who._replace(
                pitch=who.pitch + int(rng.integers(-6, 7)), pace=round(who.pace * float(rng.uniform(0.88, 1.12)))
            )
            _write(file, write_flac(speech.recorded(synthesise(varied, text), varied, rng), rate=RATE))
        done += 1
        progress(done, total)
    _write(chapter / f"{who.number}-1.trans.txt", "".join(lines).encode())
    return done


def _claim(folder: Path, settings: Struct) -> None:
    """Note what a folder is made with; PayloadError where it was made otherwise, or holds something else."""
    file = folder / SETTINGS
    told = msgspec.json.encode(settings)
    if file.is_file():
        if file.read_bytes() != told:
            raise PayloadError(
                f"{folder} holds a stand-in made with other settings: {file.read_text(encoding='utf-8')[:200]}",
                remedy="name another folder, or remove that one",
            )
        return
    if folder.is_dir() and any(folder.iterdir()):
        raise PayloadError(f"{folder} is not empty, and holds no stand-in", remedy="name another folder")
    _write(file, told)


def _write(file: Path, data: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.parent / f".{uuid.uuid4().hex}"
    temporary.write_bytes(data)
    temporary.replace(file)
