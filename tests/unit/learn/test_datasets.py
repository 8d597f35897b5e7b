"""Stand-ins and the layouts they are in: what is written is what the loaders of the real data read."""

import io
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from appliance.errors import PayloadError, PrerequisiteError
from appliance.learn.datasets import clips as drawn
from appliance.learn.datasets import make, speech
from appliance.learn.datasets.avi import write_avi
from appliance.learn.datasets.check import check, sizes
from appliance.learn.datasets.flac import write_flac
from appliance.learn.datasets.make import Clips, Speech, make_clips, make_speech
from appliance.skills._lib.learning import librispeech, models, ucf101
from appliance.skills._lib.learning.listings import DataError
from tests.unit.learn.conftest import CLIPS, hum

Words = Callable[..., Path]


def test_clips_are_laid_out_as_ucf101(made_clips: Path) -> None:
    """The loader finds every clip that was drawn, by the official lists, with its class and site."""
    train, test = ucf101.read(made_clips, "train"), ucf101.read(made_clips, "test")
    assert (len(train.items), len(test.items)) == (30, 20)
    assert train.classes == test.classes == drawn.CLASSES == models.read("clips").classes
    assert train.damaged == test.damaged == ()
    assert set(train.groups).isdisjoint(test.groups), "a site is trained on or tested on, never both"
    assert train.items == tuple(sorted(train.items))
    assert ucf101.read(made_clips / ucf101.VIDEOS, "train").items == train.items, "either folder may be named"


def test_a_clip_is_a_video_of_its_pictures(made_clips: Path) -> None:
    """An AVI file has the length its header says, 16 pictures at the places in its index, each a whole JPEG."""
    data = next((made_clips / ucf101.VIDEOS / "Walk").glob("*.avi")).read_bytes()
    assert struct.unpack("<I", data[4:8])[0] + 8 == len(data)
    movi, index = data.index(b"movi"), data.index(b"idx1")
    assert struct.unpack("<I", data[index + 4 : index + 8])[0] == 16 * drawn.FRAMES
    for number in range(drawn.FRAMES):
        _, _, offset, size = struct.unpack("<4sIII", data[index + 8 + 16 * number : index + 24 + 16 * number])
        start = movi + offset
        assert data[start : start + 4] == b"00dc"
        picture = Image.open(io.BytesIO(data[start + 8 : start + 8 + size]))
        picture.load()
        assert picture.size == (drawn.WIDTH, drawn.HEIGHT)


def test_clips_follow_from_the_seed() -> None:
    """The same seed draws the same bytes anywhere; another seed, site, action or number draws others."""

    def draw(seed: int, group: int, action: str, number: int) -> bytes:
        return b"".join(drawn.clip(drawn.site(seed, group), action, seed, group, number))

    first = draw(1, 2, "Run", 3)
    assert draw(1, 2, "Run", 3) == first
    assert len({first, draw(2, 2, "Run", 3), draw(1, 3, "Run", 3), draw(1, 2, "Walk", 3), draw(1, 2, "Run", 4)}) == 5


def test_making_goes_on_where_it_was(tmp_path: Path, made_clips: Path) -> None:
    """A making that was stopped leaves whole files and no lists; begun again it makes what is missing."""
    folder = tmp_path / "again"

    def stop(done: int, total: int) -> None:
        if done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_clips(folder, CLIPS, progress=stop)
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*.avi")}
    assert len(before) == 7
    with pytest.raises(DataError, match="not laid out like UCF101"):
        ucf101.read(folder, "train")
    told: list[tuple[int, int]] = []
    assert make_clips(folder, CLIPS, progress=lambda done, total: told.append((done, total))) == 50
    assert told[-1] == (50, 50)
    assert {file: file.stat().st_mtime_ns for file in before} == before
    assert ucf101.read(folder, "train").items == ucf101.read(made_clips, "train").items


def test_a_stand_in_whose_making_was_interrupted_is_not_whole(tmp_path: Path, clips: Path, make_words: Words) -> None:
    """It is made to its end before a run trains on it; a user's own data set is taken as it is."""
    assert make.is_whole(clips)
    words = make_words()
    assert make.is_whole(words)
    assert not make.is_whole(tmp_path / "absent")
    (clips / ucf101.LISTS / "testlist01.txt").unlink()
    assert not make.is_whole(clips)
    (words / librispeech.HOME / "SPEAKERS.TXT").unlink()
    assert not make.is_whole(words)
    (words / make.SETTINGS).unlink()
    assert make.is_whole(words)


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path, clips: Path) -> None:
    """Nothing is written where other files lie, or a stand-in with other settings."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    with pytest.raises(PayloadError, match="is not empty"):
        make_clips(tmp_path / "mine", CLIPS)
    with pytest.raises(PayloadError, match="other settings"):
        make_clips(clips, Clips(seed=9))
    with pytest.raises(PayloadError, match="no stand-in 'songs'"):
        make_speech(tmp_path / "songs", Speech(kind="songs"), synthesise=hum)
    assert not (tmp_path / "songs").exists()


def test_words_are_laid_out_as_librispeech(make_words: Words) -> None:
    """The loader finds every recording with its transcript and speaker; test speakers are others."""
    folder = make_words()
    train, test = librispeech.read(folder, "train"), librispeech.read(folder, "test")
    assert (len(train.items), len(test.items)) == (24, 12)
    assert train.groups == ("1", "2", "3", "4")
    assert test.groups == ("5", "6")
    assert {item.label for item in train.items} <= set(models.read("words").classes)
    assert train.damaged == train.notes == ()
    assert librispeech.read(folder / "LibriSpeech", "train").items == train.items


def test_sentences_use_symbols_that_the_model_knows() -> None:
    """Each sentence of the grammar can be written with the symbols of `sentences`."""
    known = set(models.read("sentences").classes)
    said = speech.sentences(3)
    texts = [next(said) for _ in range(500)]
    assert len(set(texts)) > 300
    assert set("".join(texts)) <= known
    assert texts == [text for text, _ in zip(speech.sentences(3), range(500), strict=False)]


def test_speakers_differ() -> None:
    """Neighbouring speakers have different voices, and a speaker is the same each time."""
    people = [speech.speaker(1, number) for number in range(1, 41)]
    assert len({(who.accent, who.voice) for who in people}) == 40
    assert people[3] == speech.speaker(1, 4)
    assert {who.sex for who in people} == {"M", "F"}


def test_without_a_program_to_speak_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Speech needs espeak-ng; where it is not, the error names the package."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PrerequisiteError) as caught:
        make_speech(tmp_path / "words", Speech(kind="words"))
    assert "apt-get install espeak-ng" in caught.value.remedy


def test_what_espeak_says_is_read_though_its_length_is_not_known(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Written to a pipe, the header of its sound has no length: all that follows is the sound, brought to 16 kHz."""
    program = tmp_path / "espeak-ng"
    program.write_text(
        "#!/usr/bin/python3\nimport sys\n"
        "sys.stdout.buffer.write(b'RIFF\\xff\\xff\\xff\\x7fWAVEfmt ' + bytes(20) + b'data\\xff\\xff\\xff\\x7f')\n"
        "sys.stdout.buffer.write(b'\\x00\\x10' * 22050)\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin")
    wave = speech.espeak(speech.speaker(1, 1), "GO")
    assert len(wave) == 16_000
    assert wave[8000] == pytest.approx(4096 / 32768, abs=1e-3)
    program.write_text("#!/bin/sh\necho no such voice >&2\nexit 1\n")
    with pytest.raises(PrerequisiteError, match="no such voice"):
        speech.espeak(speech.speaker(1, 1), "GO")


@given(st.lists(st.integers(-32768, 32767), min_size=1, max_size=9000))
def test_a_flac_file_holds_the_samples(values: list[int]) -> None:
    """Whatever is recorded, the file's header and its verbatim frames hold exactly that."""
    samples = np.array(values, dtype=np.int16)
    data = write_flac(samples, rate=16_000)
    bits = int.from_bytes(data[18:26], "big")
    assert (bits >> 44, (bits >> 41 & 7) + 1, (bits >> 36 & 31) + 1, bits & (1 << 36) - 1) == (
        16_000,
        1,
        16,
        len(values),
    )
    assert data.count(samples[:4096].astype(">i2").tobytes()) >= 1


# --- damage


def test_damaged_clips_are_left_out_and_counted(clips: Path) -> None:
    """A clip that is cut off, empty, of another format, missing or in the wrong place is left out with the reason."""
    listing = ucf101.read(clips, "train")
    files = [clips / item.path for item in listing.items]
    files[0].write_bytes(files[0].read_bytes()[:900])
    files[1].write_bytes(b"")
    files[2].write_bytes(b"\x80\x04 a pickle of some kind")
    files[3].unlink()
    damaged = {damage.path: damage.reason for damage in ucf101.read(clips, "train").damaged}
    paths = [item.path for item in listing.items]
    assert set(damaged) == set(paths[:4])
    assert damaged[paths[0]].startswith("truncated: 900 of")
    assert damaged[paths[1]] == "empty"
    assert damaged[paths[2]] == "no AVI file"
    assert "No such file" in damaged[paths[3]]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("Walk/v_Walk_g09_c01.avi 7", "label 7 of 10"),
        ("Walk/v_Walk_g09_c01.avi 99", "label 99 of 10"),
        ("Fly/v_Fly_g09_c01.avi 1", "class Fly is not in classInd.txt"),
        ("Walk/v_Run_g09_c01.avi 1", "a clip of Run in the folder of Walk"),
        ("../../etc/passwd 1", "not CLASS/"),
        ("Walk/holiday.avi 1", "not CLASS/"),
    ],
)
def test_lines_of_a_list_that_cannot_be(clips: Path, line: str, reason: str) -> None:
    """A label out of range, an unknown class or a path that leads elsewhere is damage, never an item."""
    file = clips / ucf101.LISTS / "trainlist01.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines, line, lines[0]]))
    listing = ucf101.read(clips, "train")
    assert any(reason in damage.reason for damage in listing.damaged), listing.damaged
    assert any(damage.reason == "listed twice" for damage in listing.damaged)


def test_the_name_that_ucf101_writes_in_two_ways_is_one_class(tmp_path: Path) -> None:
    """Files of HandstandPushups are named v_HandStandPushups: they are of the class that their folder names."""
    folder = tmp_path / ucf101.VIDEOS / "HandstandPushups"
    folder.mkdir(parents=True)
    (folder / "v_HandStandPushups_g01_c01.avi").write_bytes(write_avi([b"jpeg"], width=8, height=8, fps=1))
    lists = tmp_path / ucf101.LISTS
    lists.mkdir()
    (lists / "classInd.txt").write_text("1 HandstandPushups\n")
    (lists / "trainlist01.txt").write_text("HandstandPushups/v_HandStandPushups_g01_c01.avi 1\r\n")
    listing = ucf101.read(tmp_path, "train")
    assert [(item.label, item.group) for item in listing.items] == [("HandstandPushups", "g01")]


@pytest.mark.parametrize("text", ["1 Walk\n3 Run\n", "1 Walk\n2 Walk\n", "Walk\n", ""])
def test_a_list_of_classes_that_contradicts_itself_is_refused(clips: Path, text: str) -> None:
    """Numbers that are left out or given twice would give two clients different classes: the file is named."""
    (clips / ucf101.LISTS / "classInd.txt").write_text(text)
    with pytest.raises(DataError, match=r"classInd\.txt"):
        ucf101.read(clips, "train")


def _with_header(samples: int, *, rate: int = 16_000, channels: int = 1) -> bytes:
    data = bytearray(write_flac(np.zeros(samples, dtype=np.int16), rate=rate))
    bits = int.from_bytes(data[18:26], "big") & ~(7 << 41) | (channels - 1) << 41
    data[18:26] = bits.to_bytes(8, "big")
    return bytes(data)


def test_damaged_recordings_are_left_out_and_counted(make_words: Words) -> None:
    """Mixed rates, two channels, no sound, no transcript, an empty one, another format: each is reported."""
    folder = make_words(recordings=10)
    chapter = folder / "LibriSpeech" / "train-synthetic" / "1" / "1"
    files = sorted(chapter.glob("*.flac"))
    files[0].write_bytes(_with_header(100, rate=44_100))
    files[1].write_bytes(_with_header(100, channels=2))
    files[2].write_bytes(b"ID3 a song")
    files[3].write_bytes(b"")
    files[4].unlink()
    shutil.copy(files[5], chapter / "1-1-0777.flac")
    text = chapter / "1-1.trans.txt"
    text.write_text(text.read_text().replace(f"{files[6].stem} ", f"{files[6].stem}\n1-1-0888 "))
    damaged = {Path(damage.path).stem: damage.reason for damage in librispeech.read(folder, "train").damaged}
    assert damaged == {
        "1-1-0000": "44,100 Hz, not 16,000",
        "1-1-0001": "2 channels, not one",
        "1-1-0002": "no FLAC file",
        "1-1-0003": "empty",
        "1-1-0004": "cannot be read: No such file or directory",
        "1-1-0006": "an empty transcript",
        "1-1-0777": "no transcript in 1-1.trans.txt",
        "1-1-0888": "cannot be read: No such file or directory",
    }


def test_what_is_neither_layout_is_refused(tmp_path: Path) -> None:
    """A folder without either layout, or a LibriSpeech without the split, says what it should look like."""
    with pytest.raises(DataError, match="not laid out like UCF101") as caught:
        ucf101.read(tmp_path)
    assert "trainlist01.txt" in caught.value.remedy
    (tmp_path / "LibriSpeech" / "train-clean-100").mkdir(parents=True)
    with pytest.raises(DataError, match="no subset test"):
        librispeech.read(tmp_path, "test")
    with pytest.raises(PayloadError, match="has neither"):
        check(tmp_path / "LibriSpeech" / "train-clean-100")


def test_check_tells_what_a_folder_holds(clips: Path) -> None:
    """The report has items, sites, classes and damage of each split, and whether a client would train on it."""
    report = check(clips)
    assert report.layout == "UCF101"
    assert [(each.split, each.items, each.groups, each.refused) for each in report.splits] == [
        ("train", 30, 3, ""),
        ("test", 20, 2, ""),
    ]
    assert report.splits[0].per_class == dict.fromkeys(drawn.CLASSES, 3)
    for item in ucf101.read(clips, "train").items[:2]:
        (clips / item.path).write_bytes(b"")
    train = check(clips).splits[0]
    assert train.damaged == 2
    assert "2 of 30 files are damaged, more than 5%" in train.refused
    assert train.damaged_files[0][1] == "empty"


def test_check_of_speech(make_words: Words) -> None:
    """A folder of recordings is reported as LibriSpeech, with its speakers; a missing split is reported, not raised."""
    folder = make_words()
    report = check(folder)
    assert report.layout == "LibriSpeech"
    assert [(each.items, each.groups) for each in report.splits] == [(24, 4), (12, 2)]
    shutil.rmtree(folder / "LibriSpeech" / "test-synthetic")
    assert "no subset test" in check(folder).splits[1].refused


def test_sizes_of_a_partition(clips: Path) -> None:
    """How many items each client will have is reported before anything runs; what cannot be shared out is refused."""
    assert sizes(clips, by="site", of=3, seed=1) == (10, 10, 10)
    assert sum(sizes(clips, by="dirichlet:0.5", of=4, seed=1)) == 30
    with pytest.raises(PayloadError, match="3 groups for 5 clients by site"):
        sizes(clips, by="site", of=5, seed=1)


def test_settings_are_noted(made_clips: Path) -> None:
    """What a folder was made with lies beside the data."""
    assert b'"train_sites":3' in (made_clips / make.SETTINGS).read_bytes()
