"""Sound as numbers: log-mel spectrograms, resampling, noise reduction and pauses, in numpy.

Waves are float32 from -1 to 1, one channel, 16 kHz.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Wave = NDArray[np.float32]

RATE = 16_000
WINDOW, HOP = 400, 160
"""25 ms, every 10 ms."""
BANDS = 40
_BINS = 512
_LOW_HZ, _HIGH_HZ = 60.0, 7600.0
_FLOOR = 1e-6


def frames_of(samples: int) -> int:
    """Return how many frames `log_mel` makes of so many samples: 98 of a second."""
    return max(0, 1 + (samples - WINDOW) // HOP)


def log_mel(wave: Wave) -> NDArray[np.float32]:
    """Return the log-mel spectrogram, (frames, 40), each band less its mean over time, so that loudness is left out."""
    count = frames_of(len(wave))
    if not count:
        return np.zeros((0, BANDS), dtype=np.float32)
    at = np.arange(count)[:, None] * HOP + np.arange(WINDOW)[None, :]
    spectrum = np.abs(np.fft.rfft(wave[at] * np.hanning(WINDOW), _BINS)) ** 2
    mel = np.log(spectrum @ _filters() + _FLOOR)
    return (mel - mel.mean(axis=0)).astype(np.float32)


@lru_cache(maxsize=1)
def _filters() -> NDArray[np.float64]:
    """Return the triangular mel filters, (bins, bands)."""
    edges = _hertz(np.linspace(_mel(_LOW_HZ), _mel(_HIGH_HZ), BANDS + 2))
    bins = np.fft.rfftfreq(_BINS, 1 / RATE)[:, None]
    low, middle, high = edges[:-2], edges[1:-1], edges[2:]
    return np.maximum(0.0, np.minimum((bins - low) / (middle - low), (high - bins) / (high - middle)))


def _mel(hertz: float) -> float:
    return float(2595.0 * np.log10(1.0 + hertz / 700.0))


def _hertz(mel: NDArray[np.float64]) -> NDArray[np.float64]:
    return 700.0 * (10.0 ** (mel / 2595.0) - 1.0)


def fit(wave: Wave, samples: int) -> Wave:
    """Return a wave of that length: the middle of a longer one, a shorter one between silence."""
    spare = len(wave) - samples
    if spare >= 0:
        return wave[spare // 2 : spare // 2 + samples]
    return np.pad(wave, (-spare // 2, -spare - -spare // 2)).astype(np.float32)


def resample(wave: NDArray[np.floating], rate: int) -> Wave:
    """Return a wave of 16 kHz from one of another rate, (samples,) or (samples, channels), through its spectrum."""
    mono = wave.mean(axis=1) if wave.ndim == 2 else wave
    if rate == RATE or not len(mono):
        return mono.astype(np.float32)
    target = max(1, round(len(mono) * RATE / rate))
    spectrum = np.fft.rfft(mono)
    kept = np.zeros(target // 2 + 1, dtype=spectrum.dtype)
    shared = min(len(kept), len(spectrum))
    kept[:shared] = spectrum[:shared]
    return (np.fft.irfft(kept, target) * (target / len(mono))).astype(np.float32)


NOISE_S = 60
"""Noise is estimated again each minute: it changes, and memory is bounded."""


def denoise(wave: Wave, *, strength: float = 1.5) -> Wave:
    """Return a wave with steady noise reduced: spectral subtraction (Boll 1979) of what the quietest tenth has."""
    parts = [_denoised(wave[at : at + NOISE_S * RATE], strength) for at in range(0, len(wave), NOISE_S * RATE)]
    return np.concatenate(parts) if parts else wave


def _denoised(wave: Wave, strength: float) -> Wave:
    if len(wave) < WINDOW * 4:
        return wave
    window = np.hanning(WINDOW + 1)[:-1]
    step = WINDOW // 2
    padded = np.pad(wave, (step, WINDOW + step))
    count = 1 + (len(padded) - WINDOW) // step
    at = np.arange(count)[:, None] * step + np.arange(WINDOW)[None, :]
    spectrum = np.fft.rfft(padded[at] * window)
    size = np.abs(spectrum)
    loud = size.sum(axis=1)
    noise = size[loud <= np.quantile(loud, 0.1)].mean(axis=0)
    gain = np.maximum(0.05, 1.0 - strength * noise / np.maximum(size, _FLOOR))
    parts = np.fft.irfft(spectrum * gain, WINDOW)
    out = np.zeros(len(padded))
    np.add.at(out, at, parts)
    return out[step : step + len(wave)].astype(np.float32)


def voiced(wave: Wave, *, pause_s: float = 0.4, least_s: float = 0.2) -> list[tuple[int, int]]:
    """Return the spans of samples with sound, parted at pauses.

    A frame counts as sound when it has ten times the energy of the quietest tenth and a thousandth of the loudest.

    Args:
        wave: what is looked through.
        pause_s: shorter silence does not part.
        least_s: shorter sound is left out.
    """
    count = frames_of(len(wave))
    if not count:
        return []
    sums = np.concatenate([np.zeros(1), np.cumsum(np.square(wave, dtype=np.float64))])
    starts = np.arange(count) * HOP
    energy = (sums[starts + WINDOW] - sums[starts]) / WINDOW
    threshold = max(10.0 * float(np.quantile(energy, 0.1)), 1e-3 * float(energy.max()), 1e-8)
    loud = np.flatnonzero(energy > threshold)
    if not len(loud):
        return []
    parts = np.split(loud, np.flatnonzero(np.diff(loud) * HOP > pause_s * RATE) + 1)
    spans = [
        (max(0, int(part[0]) * HOP - HOP * 5), min(len(wave), int(part[-1]) * HOP + WINDOW + HOP * 5)) for part in parts
    ]
    return [(start, end) for start, end in spans if end - start - HOP * 10 >= least_s * RATE]
