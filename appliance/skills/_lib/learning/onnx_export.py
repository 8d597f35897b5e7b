# pyright: basic, reportMissingImports=false
# PyTorch is in image `learn` only.
"""Writes a network as an ONNX file, with what it makes of some inputs, by which the file is checked elsewhere."""

import io
import warnings
from typing import Any

import torch

from .models import Model
from .samples import SHAPES, sample

OPSET = 13
"""Of ONNX: the newest that PyTorch 1.13 writes well."""
INPUT, OUTPUT = "input", "output"


def to_onnx(module: Any, model: Model) -> tuple[bytes, list[dict[str, Any]]]:
    """Return a network's ONNX file, and of each sample its shape, the shape of what comes out, and its values in a row.

    The batch may have any size, recordings of sentences any length. Input and output are named `input` and `output`.

    Raises:
        ValueError: PyTorch cannot write a layer of it.
    """
    module.eval()
    inputs = {0: "batch"}
    outputs = {0: "batch"}
    if model.task == "transcribe":  # its output is (steps, batch, symbols)
        inputs, outputs = {0: "batch", 1: "frames"}, {0: "steps", 1: "batch"}
    shapes = SHAPES[model.input]
    file = io.BytesIO()
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # of what is constant for each input kind
            torch.onnx.export(
                module, torch.from_numpy(sample(shapes[-1])), file, input_names=[INPUT], output_names=[OUTPUT],
                opset_version=OPSET, dynamic_axes={INPUT: inputs, OUTPUT: outputs},
            )  # fmt: skip
            checks = [_made(module, shape) for shape in shapes]
    except RuntimeError as error:  # also torch.onnx's own, of an operator that there is not
        raise ValueError(f"PyTorch {torch.__version__} cannot write it as ONNX: {str(error)[:300]}") from error
    return file.getvalue(), checks


def _made(module: Any, shape: tuple[int, ...]) -> dict[str, Any]:
    out = module(torch.from_numpy(sample(shape)))
    return {"input": list(shape), "output": list(out.shape), "values": [float(each) for each in out.flatten()]}
