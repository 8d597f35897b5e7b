"""What is said in the stand-ins for speech, by whom, and how it sounds where it is recorded.

Speech is made by the program espeak-ng, which is a tool here and no part of the product; each speaker has an accent, a
voice, a pitch and a pace, a room and a level of noise. Sentences are orders to robots, from a small grammar.
"""

import itertools
import shutil
import subprocess
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from appliance.errors import PrerequisiteError
from appliance.skills._lib.learning.sounds import RATE, resample

WORDS = ("ONE", "TWO", "THREE", "GO", "STOP", "LEFT", "RIGHT", "UP", "DOWN", "YES", "NO", "HOME")
ACCENTS = ("en-us", "en-gb", "en-gb-scotland", "en-gb-x-rp", "en-029", "en-gb-x-gbclan", "en-gb-x-gbcwmd")
VOICES = ("m1", "m2", "m3", "m4", "m5", "m6", "m7", "f1", "f2", "f3", "f4", "f5")
ESPEAK_RATE = 22_050

Samples = NDArray[np.int16]
Synthesise = Callable[["Speaker", str], NDArray[np.float32]]
"""Say a text: a wave of 16 kHz from -1 to 1."""


class Speaker(NamedTuple):
    """A person: `number` as in SPEAKERS.TXT, and how that person sounds."""

    number: int
    accent: str
    voice: str
    pitch: int
    pace: int
    room_s: float
    noise: float

    @property
    def sex(self) -> str:
        """M or F."""
        return self.voice[0].upper()


def speaker(seed: int, number: int) -> Speaker:
    """Return a speaker, the same for the same seed; neighbouring numbers have different voices."""
    rng = np.random.Generator(np.random.Philox([seed, number]))
    pairs = len(ACCENTS) * len(VOICES)
    chosen = int(np.random.Generator(np.random.Philox([seed, 0])).permutation(pairs)[number % pairs])
    return Speaker(
        number=number,
        accent=ACCENTS[chosen // len(VOICES)],
        voice=VOICES[chosen % len(VOICES)],
        pitch=int(rng.integers(25, 75)),
        pace=int(rng.integers(125, 200)),
        room_s=float(rng.uniform(0.05, 0.4)),
        noise=float(rng.uniform(0.002, 0.03)),
    )


def espeak(who: Speaker, text: str) -> NDArray[np.float32]:
    """Say a text with espeak-ng.

    Raises:
        PrerequisiteError: it is not installed, or fails.
    """
    program = shutil.which("espeak-ng")
    if program is None:
        raise PrerequisiteError(
            "speech is made with espeak-ng, which is not installed", remedy="apt-get install espeak-ng"
        )
    voice = f"{who.accent}+{who.voice}"
    command = (program, "-v", voice, "-p", str(who.pitch), "-s", str(who.pace), "--stdout", text.lower())
    done = subprocess.run(command, capture_output=True, timeout=60, check=False)
    start = done.stdout.find(b"data")
    if done.returncode or start < 0:
        words = done.stderr.decode("utf-8", "replace").strip()[:200]
        raise PrerequisiteError(
            f"espeak-ng failed: {words or done.returncode}", remedy="see that it has English voices"
        )
    # The length in the header is not known when it is written to a pipe: what follows it is the sound.
    data = done.stdout[start + 8 :]
    samples = np.frombuffer(data[: len(data) // 2 * 2], dtype="<i2")
    return resample(samples.astype(np.float32) / 32768.0, ESPEAK_RATE)


def recorded(wave: NDArray[np.float32], who: Speaker, rng: np.random.Generator) -> Samples:
    """Return a wave as it is recorded: in the speaker's room, with noise, at some distance."""
    echo = rng.standard_normal(int(who.room_s * RATE), dtype=np.float32) if who.room_s else np.zeros(0, np.float32)
    echo *= np.exp(-6.0 * np.arange(len(echo), dtype=np.float32) / max(1, len(echo))) * 0.05
    pulse = np.concatenate([np.ones(1, dtype=np.float32), echo])
    size = 1 << (len(wave) + len(pulse)).bit_length()
    heard = np.fft.irfft(np.fft.rfft(wave, size) * np.fft.rfft(pulse, size), size)[: len(wave) + len(echo) // 2]
    heard = heard / max(1e-6, float(np.abs(heard).max())) * rng.uniform(0.25, 0.9)
    heard = heard + rng.standard_normal(len(heard)) * who.noise
    return np.clip(np.rint(heard * 32767), -32768, 32767).astype(np.int16)


# --- what is said

_ROBOTS = ("ROVER ONE", "ROVER TWO", "DRONE ONE", "DRONE TWO", "THE ARM", "ROBOT THREE", "ROBOT FOUR")
_PLACES = (
    "DOCK ONE", "DOCK TWO", "DOCK THREE", "THE GATE", "THE LAB", "THE OFFICE", "THE YARD", "AISLE FOUR", "THE CHARGER",
    "SHELF NINE", "THE LOADING BAY", "THE ROOF",
)  # fmt: skip
_THINGS = (
    "THE RED BOX", "THE BLUE CRATE", "THE GREEN PALLET", "A PARCEL", "THE TOOL BOX", "THE YELLOW BARREL", "THE LADDER",
    "THE METER", "THE VALVE", "THE LIGHT",
)  # fmt: skip
_ORDERS = (
    "{robot} GO TO {place}", "{robot} FETCH {thing} FROM {place}", "{robot} TAKE A PHOTO OF {thing}",
    "{robot} BRING {thing} TO {place}", "GO TO {place} AND LOOK FOR {thing}", "{robot} INSPECT {thing} AT {place}",
    "{robot} COUNT THE BOXES IN {place}", "{robot} RETURN TO {place}", "{robot} FOLLOW ME TO {place}",
    "{robot} FILM {place} FOR TWO MINUTES", "{robot} PUT {thing} ON {place}", "{robot} WAIT AT {place}",
    "TELL ME WHAT YOU SEE AT {place}", "{robot} READ {thing} AND REPORT", "{robot} OPEN THE DOOR AT {place}",
    "{robot} SWITCH ON {thing}", "{robot} CHARGE AT {place} THEN FETCH {thing}", "IS {thing} STILL AT {place}",
)  # fmt: skip


def sentences(seed: int) -> Iterator[str]:
    """Yield sentences without end, the same for the same seed."""
    rng = np.random.Generator(np.random.Philox(seed))
    while True:
        order = _ORDERS[int(rng.integers(len(_ORDERS)))]
        yield order.format(
            robot=_ROBOTS[int(rng.integers(len(_ROBOTS)))],
            place=_PLACES[int(rng.integers(len(_PLACES)))],
            thing=_THINGS[int(rng.integers(len(_THINGS)))],
        )


def words(seed: int) -> Iterator[str]:
    """Yield the words without end: each once, in an order of its own, then again."""
    rng = np.random.Generator(np.random.Philox(seed))
    for _ in itertools.count():
        for index in rng.permutation(len(WORDS)):
            yield WORDS[int(index)]
