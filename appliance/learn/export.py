"""A model's files as people take them away, checked before they are written.

Safetensors: the shards and their manifest. ONNX: one file, made by PyTorch in a container of image `learn`; here
onnxruntime has to make of some inputs what PyTorch made of them with the model's own parameters.
"""

from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from appliance.errors import ConfigError, PayloadError
from appliance.skills._lib.learning import samples, shards

TOLERANCE = 1e-4
"""Largest difference of an output, absolute up to 1 and relative above: sums are in another order there."""
MOST_VALUES = 1 << 22


class Check(Struct, frozen=True, kw_only=True):
    """What PyTorch made of `samples.sample(input)`: the shape of its output, and the values in a row."""

    input: tuple[int, ...]
    output: tuple[int, ...]
    values: tuple[float, ...]


def check_files(manifest: bytes, files: list[bytes]) -> shards.Manifest:
    """Return the manifest of a model whose files are whole and right; PayloadError otherwise."""
    try:
        found = shards.parse_manifest(msgspec.json.decode(manifest))
        if len(files) != len(found.shards):
            raise PayloadError(f"{len(files)} files for {len(found.shards)} shards")
        for index, data in enumerate(files):
            shards.decode(data, found, index)
    except (shards.ModelFileError, msgspec.DecodeError) as error:
        raise PayloadError(f"the model's files are not sound: {error}") from error
    return found


def check_onnx(data: bytes, checks: bytes) -> float:
    """Return by how much onnxruntime's outputs differ from PyTorch's at most.

    Raises:
        PayloadError: by more than `TOLERANCE`, or the file is no such model.
    """
    import onnxruntime  # noqa: PLC0415 - 70 ms, and only here

    try:
        wanted = msgspec.json.decode(checks, type=tuple[Check, ...])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(f"what the model makes of samples cannot be read: {error}") from error
    if not wanted or any(np.prod(each.input) > MOST_VALUES for each in wanted):
        raise PayloadError("there is no sample, or one that is too large, to check the ONNX file with")
    try:
        session: Any = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
        made = [
            cast("NDArray[np.float32]", session.run(["output"], {"input": samples.sample(each.input)})[0])
            for each in wanted
        ]
    except Exception as error:  # onnxruntime raises classes of its own that have only this in common
        raise PayloadError(f"onnxruntime cannot use the ONNX file: {str(error)[:300]}") from error
    worst = 0.0
    for each, found in zip(wanted, made, strict=True):
        if found.shape != each.output or found.size != len(each.values):
            raise PayloadError(f"the ONNX file makes {found.shape} of a sample, PyTorch {each.output}")
        expected = np.array(each.values).reshape(each.output)
        difference = np.abs(found - expected) / np.maximum(1.0, np.abs(expected))
        worst = max(worst, float(np.nan_to_num(difference, nan=np.inf).max(initial=0.0)))
    if worst > TOLERANCE:
        raise PayloadError(f"the ONNX file differs from the model by {worst:.2g}, at most {TOLERANCE:g} is rounding")
    return worst


def write_files(folder: Path, manifest: bytes, files: list[bytes], classes: tuple[str, ...] = ()) -> list[Path]:
    """Write `manifest.json`, `model-00000.safetensors`, … and, a class a line, `classes.txt`; returns the paths.

    Symbols, of which one is a blank and one a space, are no classes of data: the model names them itself.

    Raises:
        ConfigError: it cannot be written.
    """
    named = {f"model-{index:05d}.safetensors": data for index, data in enumerate(files)}
    return _write(folder, named | {"manifest.json": manifest} | _class_file(classes))


def write_onnx(folder: Path, name: str, data: bytes, classes: tuple[str, ...] = ()) -> list[Path]:
    """Write `NAME.onnx` and `classes.txt` as `write_files` does; returns the paths. ConfigError where it cannot."""
    return _write(folder, {f"{name}.onnx": data} | _class_file(classes))


def _class_file(classes: tuple[str, ...]) -> dict[str, bytes]:
    if classes and all(name and name == name.strip() and name.isprintable() for name in classes):
        return {"classes.txt": "".join(f"{name}\n" for name in classes).encode()}
    return {}


def _write(folder: Path, named: dict[str, bytes]) -> list[Path]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in named.items():
            temporary = folder / f".{name}.part"
            temporary.write_bytes(data)
            temporary.replace(folder / name)
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written: {error.strerror}", remedy="give another folder") from error
    return [folder / name for name in named]
