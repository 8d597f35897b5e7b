"""Items as arrays: decoded once, kept, bounded; damage that only decoding shows."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.skills._lib.learning import loading, sounds, ucf101
from appliance.skills._lib.learning.decoders import CorruptFileError
from appliance.skills._lib.learning.listings import Damage, DataError, Item, Listing, refuse_if_damaged
from appliance.skills._lib.learning.loading import Array, Kind


def _listing(folder: Path, count: int) -> Listing:
    for number in range(count):
        (folder / f"{number:03d}.avi").write_bytes(bytes([number]))
    return Listing(folder, tuple(Item(f"{number:03d}.avi", "A", "g") for number in range(count)))


class Decoder:
    """Stands in for the decoders: a file's first byte is its content, files of one name are broken."""

    def __init__(self, broken: int = -1) -> None:
        self.calls = 0
        self.broken = broken

    def __call__(self, path: Path, kind: Kind) -> Array:
        """Return the file's content as an array."""
        del kind
        self.calls += 1
        if int(path.stem) == self.broken:
            raise CorruptFileError("moov atom not found")
        return np.full((2, 2), path.read_bytes()[0], dtype=np.uint8)


def test_what_was_decoded_is_kept(tmp_path: Path) -> None:
    """The second time nothing is decoded; a file that has changed, or another kind of array, is decoded again."""
    listing, decode = _listing(tmp_path, 5), Decoder()
    cache = tmp_path / "cache"
    first = loading.load(listing, [0, 3], "clip", cache=cache, decode=decode)
    assert [int(array[0, 0]) for array in first.arrays] == [0, 3]
    again = loading.load(listing, [3, 0], "clip", cache=cache, decode=decode)
    assert [int(array[0, 0]) for array in again.arrays] == [3, 0]
    assert decode.calls == 2
    loading.load(listing, [0], "word", cache=cache, decode=decode)
    (tmp_path / "003.avi").write_bytes(b"\x09")
    os.utime(tmp_path / "003.avi", ns=(1, 1))
    assert int(loading.load(listing, [3], "clip", cache=cache, decode=decode).arrays[0][0, 0]) == 9
    assert decode.calls == 4


def test_a_cache_that_was_cut_off_is_made_again(tmp_path: Path) -> None:
    """A file of the cache that the machine lost half of is decoded again, and no pickle in it is ever read."""
    listing, decode = _listing(tmp_path, 1), Decoder()
    cache = tmp_path / "cache"
    loading.load(listing, [0], "clip", cache=cache, decode=decode)
    kept = next(cache.rglob("*.npy"))
    kept.write_bytes(b"")
    assert loading.load(listing, [0], "clip", cache=cache, decode=decode).arrays[0].shape == (2, 2)
    kept.write_bytes(kept.read_bytes()[:40])
    assert loading.load(listing, [0], "clip", cache=cache, decode=decode).arrays[0].shape == (2, 2)
    np.save(kept, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    assert loading.load(listing, [0], "clip", cache=cache, decode=decode).arrays[0].shape == (2, 2)
    assert decode.calls == 4


def test_items_are_read_when_they_are_used(tmp_path: Path) -> None:
    """What is in the cache costs a look at it, until it is used; slices and single items are the same arrays."""
    listing, cache = _listing(tmp_path, 6), tmp_path / "cache"
    loading.load(listing, range(6), "clip", cache=cache, decode=Decoder())
    found = loading.load(listing, range(6), "clip", cache=cache, decode=Decoder()).arrays
    assert len(found) == 6
    assert [int(array[0, 0]) for array in found[1:4]] == [1, 2, 3]
    for file in cache.rglob("*.npy"):
        file.unlink()
    assert int(found[2][0, 0]) == 2, "it is held"
    assert int(found[5][0, 0]) == 5, "it is decoded again"


def test_a_listing_is_kept_until_something_changes(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The headers of all files are looked at once; a file that goes, comes or is replaced has them looked at again."""
    cache, looks = tmp_path / "cache", 0
    real = ucf101.read

    def counted(folder: Path, split: Any) -> Listing:
        nonlocal looks
        looks += 1
        return real(folder, split)

    monkeypatch.setattr(ucf101, "read", counted)
    first = loading.read(clips, "train", cache=cache)
    assert loading.read(clips, "train", cache=cache) == first
    assert loading.read(clips, "test", cache=cache) != first
    assert looks == 2
    file = clips / first.items[0].path
    file.with_suffix(".new").write_bytes(b"no video")
    file.with_suffix(".new").replace(file)
    again = loading.read(clips, "train", cache=cache)
    assert (looks, len(again.items), len(again.damaged)) == (3, len(first.items) - 1, 1)
    kept = next((cache / "listings").glob("*.json"))
    for each in (cache / "listings").glob("*.json"):
        each.write_text(kept.read_text()[:50])
    assert loading.read(clips, "train", cache=cache) == again


def test_a_listing_of_recordings_is_kept(make_words: Callable[..., Path], tmp_path: Path) -> None:
    """A transcript that changes has the listing read again."""
    folder, cache = make_words(), tmp_path / "cache"
    first = loading.read(folder, "train", cache=cache)
    assert loading.read(folder, "train", cache=cache) == first
    text = next((folder / "LibriSpeech" / "train-synthetic").rglob("*.trans.txt"))
    text.write_text(text.read_text() + "1-1-0999 NOTHING\n")
    os.utime(text, ns=(1, 1))
    assert len(loading.read(folder, "train", cache=cache).damaged) == 1


def test_what_cannot_be_decoded_is_left_out_and_remembered(tmp_path: Path) -> None:
    """A damaged file is reported with its reason, is not decoded again, and of few files in many stops nothing."""
    listing, decode = _listing(tmp_path, 30), Decoder(broken=7)
    for _ in range(2):
        found = loading.load(listing, range(30), "clip", cache=tmp_path / "cache", decode=decode)
        assert found.damaged == (Damage("007.avi", "moov atom not found"),)
        assert len(found.arrays) == len(found.items) == 29
    assert decode.calls == 30


def test_a_full_disk_costs_the_cache_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Items are decoded each time, and nothing half written is left."""
    listing, cache = _listing(tmp_path, 3), tmp_path / "cache"

    def full(path: Path, data: bytes) -> int:
        path.open("wb").close()
        raise OSError(errno.ENOSPC, f"no space for {len(data)} bytes")

    monkeypatch.setattr(Path, "write_bytes", full)
    found = loading.load(listing, [0, 2], "clip", cache=cache, decode=Decoder(broken=1))
    assert [int(array[0, 0]) for array in found.arrays] == [0, 2]
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_too_much_damage_is_refused_with_the_list(tmp_path: Path) -> None:
    """More than 5 % damaged: nothing is trained, and the files are named."""
    listing, decode = _listing(tmp_path, 10), Decoder(broken=7)
    with pytest.raises(DataError, match=r"1 of 10 files are damaged.*007\.avi: moov atom not found"):
        loading.load(listing, range(10), "clip", cache=tmp_path / "cache", decode=decode)


@given(st.integers(0, 400), st.integers(0, 40))
def test_five_percent_is_the_bound(good: int, bad: int) -> None:
    """Up to 5 % of damage is borne; a set without any good file never is."""
    damaged = [Damage(f"{number}", "empty") for number in range(bad)]
    if good and bad <= 0.05 * (good + bad):
        refuse_if_damaged(damaged, good, what="yard")
    else:
        with pytest.raises(DataError, match="yard"):
            refuse_if_damaged(damaged, good, what="yard")


def test_the_cache_is_bounded(tmp_path: Path) -> None:
    """What was written longest ago goes first, until the rest fits."""
    for number in range(6):
        file = tmp_path / "ab" / f"{number}.npy"
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(bytes(100))
        os.utime(file, (number, number))
    assert loading.prune(tmp_path, most_bytes=350) == 300
    assert sorted(file.stem for file in tmp_path.rglob("*.npy")) == ["3", "4", "5"]


@given(st.integers(1, 2000), st.integers(1, 40))
def test_pictures_are_spread_evenly(count: int, wanted: int) -> None:
    """Each picture taken exists, they are in order, and none is far from its even place."""
    chosen = loading.spread(count, wanted)
    assert len(chosen) == wanted
    assert chosen == sorted(chosen)
    assert all(0 <= at < count for at in chosen)
    assert all(abs(at - (number + 0.5) * count / wanted) <= 1 for number, at in enumerate(chosen))


def test_sixteen_pictures_are_taken_as_they_are() -> None:
    """A clip of 16 pictures is used whole."""
    assert loading.spread(16, 16) == list(range(16))


def test_a_folder_of_neither_layout(tmp_path: Path) -> None:
    """What is no data set is refused with what it should look like."""
    with pytest.raises(DataError, match="has neither"):
        loading.read(tmp_path, "train")


@pytest.mark.parametrize("split", ["train", "test"])
def test_both_layouts_are_read(made_clips: Path, make_words: Callable[..., Path], split: str) -> None:
    """One reader takes whichever layout the folder has."""
    assert loading.read(made_clips, split).classes  # type: ignore[arg-type]
    assert not loading.read(make_words(), split).classes  # type: ignore[arg-type]


# --- sound


def test_lists_alone_tell_classes_and_items(made_clips: Path, make_words: Callable[..., Path], tmp_path: Path) -> None:
    """What a run is checked by before it starts: no file is opened."""
    outline = loading.outline(made_clips)
    assert (len(outline.classes), outline.items) == (10, 30)
    assert outline.classes == loading.read(made_clips, "train").classes
    assert loading.outline(make_words()) == ((), 24)
    with pytest.raises(DataError, match="has neither"):
        loading.outline(tmp_path / "nothing")


def test_a_second_has_98_frames_of_40_bands() -> None:
    """The shape that `words` is built for."""
    wave = np.sin(np.arange(16_000, dtype=np.float32) * 0.3)
    spectrum = sounds.log_mel(wave.astype(np.float32))
    assert spectrum.shape == (98, 40)
    assert np.isfinite(spectrum).all()
    assert sounds.log_mel(wave[:100].astype(np.float32)).shape == (0, 40)


def test_a_tone_is_in_its_band_however_loud() -> None:
    """A tone that begins late stands out in one band, and ten times as loud it looks the same."""
    times = np.arange(16_000) / 16_000
    wave = np.where(times > 0.5, np.sin(2 * np.pi * 1000 * times), 0.0)
    noise = np.random.default_rng(1).normal(0, 0.01, 16_000)
    spectrum = sounds.log_mel((wave * 0.1 + noise).astype(np.float32))
    rise = spectrum[60:].mean(axis=0) - spectrum[:40].mean(axis=0)
    louder = sounds.log_mel((wave + noise * 10).astype(np.float32))
    assert np.argmax(rise) == np.argmax(louder[60:].mean(axis=0) - louder[:40].mean(axis=0))
    assert np.abs(spectrum - louder).max() < 0.1


@given(st.integers(0, 5000), st.integers(1, 5000))
def test_fit_has_the_length(length: int, wanted: int) -> None:
    """Shorter waves stand in the middle of silence, of longer ones the middle is taken."""
    wave = np.arange(1, length + 1, dtype=np.float32)
    fitted = sounds.fit(wave, wanted)
    assert len(fitted) == wanted
    assert np.count_nonzero(fitted) == min(length, wanted)


@pytest.mark.parametrize("rate", [8_000, 22_050, 44_100, 48_000])
def test_resampling_keeps_length_and_pitch(rate: int) -> None:
    """A second stays a second, and 440 Hz stay 440 Hz; two channels become one."""
    times = np.arange(rate) / rate
    tone = np.sin(2 * np.pi * 440 * times)
    wave = sounds.resample(np.stack([tone, tone], axis=1), rate)
    assert len(wave) == 16_000
    assert np.argmax(np.abs(np.fft.rfft(wave))) == 440


def test_noise_goes_and_speech_stays() -> None:
    """Where there was only noise it is at most a third as loud; a tone keeps four fifths of its energy."""
    rng = np.random.default_rng(2)
    times = np.arange(32_000) / 16_000
    tone = np.where((times > 0.8) & (times < 1.4), np.sin(2 * np.pi * 700 * times), 0.0)
    noisy = (tone + rng.normal(0, 0.05, len(times))).astype(np.float32)
    cleaned = sounds.denoise(noisy)
    assert len(cleaned) == len(noisy)
    assert np.std(cleaned[:8000]) < np.std(noisy[:8000]) / 3
    assert np.sum(cleaned[14_000:21_000] ** 2) > 0.8 * np.sum(tone[14_000:21_000] ** 2)


def test_pauses_part_what_is_said() -> None:
    """Two words with a pause are two spans; a click and silence are none."""
    rng = np.random.default_rng(3)
    wave = rng.normal(0, 0.002, 48_000).astype(np.float32)
    for start in (4_000, 30_000):
        wave[start : start + 9_000] += np.sin(np.arange(9_000) * 0.2).astype(np.float32) * 0.5
    wave[22_000:22_100] += 0.5
    spans = sounds.voiced(wave)
    assert len(spans) == 2
    assert abs(spans[0][0] - 4_000) < 1_600
    assert abs(spans[1][1] - 39_000) < 1_600
    assert sounds.voiced(np.zeros(16_000, dtype=np.float32)) == []
    assert sounds.voiced(np.zeros(10, dtype=np.float32)) == []
