# pyright: basic, reportMissingImports=false
# pocketsphinx is in image `learn` only.
"""Pocketsphinx with the English model of its Debian packages: what listens where nothing was trained."""

from pathlib import Path

import numpy as np
from _lib.context import Context
from numpy.typing import NDArray

MODEL = Path("/usr/share/pocketsphinx/model/en-us")


class Decoder:
    """A recogniser; loading it takes about a second.

    Raises:
        ctx.Fail: its model is not there.
    """

    def __init__(self, ctx: Context) -> None:
        from pocketsphinx import pocketsphinx  # noqa: PLC0415 - a second, for runs that need it

        config = pocketsphinx.Decoder.default_config()
        for name, path in (("hmm", "en-us"), ("lm", "en-us.lm.bin"), ("dict", "cmudict-en-us.dict")):
            if not (MODEL / path).exists():
                raise ctx.Fail(f"{MODEL / path} is not there", "build image learn again: swiftbot images build learn")
            config.set_string(f"-{name}", str(MODEL / path))
        config.set_string("-logfn", "/dev/null")
        self._decoder = pocketsphinx.Decoder(config)

    def hear(self, wave: NDArray[np.float32]) -> str:
        """Return what is said in a wave of 16 kHz, upper case; empty where nothing is understood."""
        samples = np.clip(np.rint(wave * 32767), -32768, 32767).astype("<i2")
        self._decoder.start_utt()
        self._decoder.process_raw(samples.tobytes(), False, True)
        self._decoder.end_utt()
        heard = self._decoder.hyp()
        return heard.hypstr.upper() if heard is not None else ""
