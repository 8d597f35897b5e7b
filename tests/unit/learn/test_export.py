"""Models as ONNX files: what is checked before one is written. PyTorch's side is tried in its container."""
# pyright: basic

from pathlib import Path

import msgspec
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from appliance.errors import ConfigError, NotFoundError, PayloadError
from appliance.learn.export import check_onnx, write_onnx
from appliance.learn.manager import _kept
from appliance.model.learning import Clients, Model, Recipe, RunRecord
from appliance.skills._lib.learning import models, orders
from appliance.skills._lib.learning.orders import OrderError
from appliance.skills._lib.learning.samples import SHAPES, sample


def scaled(factor: float) -> bytes:
    """Return the ONNX file of a model that multiplies by a factor."""
    graph = helper.make_graph(
        [helper.make_node("Mul", ["input", "factor"], ["output"])], "scaled",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, ["batch", 4])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, ["batch", 4])],
        [numpy_helper.from_array(np.array(factor, dtype=np.float32), "factor")],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    return model.SerializeToString()


def made(factor: float, *shapes: tuple[int, ...]) -> bytes:
    """Return what such a model makes of samples, as a container says it."""
    checks = [
        {"input": shape, "output": shape, "values": (sample(shape) * np.float32(factor)).flatten().tolist()}
        for shape in shapes
    ]
    return msgspec.json.encode(checks)


def test_the_same_outputs_are_the_same_model() -> None:
    """For each batch; the difference is that of rounding."""
    assert check_onnx(scaled(2.0), made(2.0, (1, 4), (3, 4))) < 1e-6


@pytest.mark.parametrize(
    ("data", "checks", "problem"),
    [
        (scaled(2.001), made(2.0, (1, 4)), "differs from the model by"),
        (scaled(float("nan")), made(2.0, (1, 4)), "differs from the model by"),
        (scaled(2.0), made(2.0, (1, 5)), "onnxruntime cannot use the ONNX file"),
        (b"no model", made(2.0, (1, 4)), "onnxruntime cannot use the ONNX file"),
        (b"", made(2.0, (1, 4)), "onnxruntime cannot use the ONNX file"),
        (scaled(2.0), b"[]", "there is no sample"),
        (scaled(2.0), b"[1", "cannot be read"),
        (scaled(2.0), b'[{"input": [1, 4], "output": [1, 5], "values": []}]', r"makes \(1, 4\)"),
        (scaled(2.0), b'[{"input": [99999999, 4], "output": [1], "values": []}]', "too large"),
    ],
)
def test_another_model_or_none_is_refused(data: bytes, checks: bytes, problem: str) -> None:
    """Other outputs, not finite ones, another shape, no ONNX, no samples: with the reason, and nothing is written."""
    with pytest.raises(PayloadError, match=problem):
        check_onnx(data, checks)


def test_a_file_is_written_whole_or_not(tmp_path: Path) -> None:
    """Into a folder that is made; where that cannot be, the error says so."""
    (path,) = write_onnx(tmp_path / "new", "clips", scaled(1.0))
    assert path == tmp_path / "new" / "clips.onnx"
    onnx.checker.check_model(onnx.load(path))
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_onnx(tmp_path / "file", "clips", b"x")


def test_samples_are_the_same_everywhere() -> None:
    """By arithmetic of whole numbers: the first values are those written here, between -1 and 1, of each kind."""
    assert SHAPES.keys() == set(models.INPUTS)
    assert sample((4,)).tolist() == [-1.0, 0.554168701171875, 0.10833740234375, -0.337493896484375]
    wide = sample((3, 1, 16, 40, 40))
    assert wide.dtype == np.float32
    assert -1.0 <= wide.min() < -0.9
    assert 0.9 < wide.max() < 1.0


def test_the_number_of_classes_follows_from_a_models_tensors() -> None:
    """Whichever data set named them; tensors for two numbers at once are refused."""
    clips = models.read("clips")
    shapes = {tensor.name: tensor.shape for tensor in clips.tensors(7)}
    assert clips.classes_of(shapes) == 7
    name = next(tensor.name for tensor in clips.tensors(7) if tensor.shape == (7,))
    with pytest.raises(ValueError, match="7 and 8 classes at once"):
        clips.classes_of(shapes | {name: (8,)})


def test_evaluate_is_asked_for_a_format_that_there_is() -> None:
    """`onnx` or none; another one is refused with what there is."""
    assert orders.evaluation({"model": "clips"}).export == ""
    assert orders.evaluation({"model": "clips", "export": "onnx"}).export == "onnx"
    with pytest.raises(OrderError, match="export is 'pickle'") as caught:
        orders.evaluation({"model": "clips", "export": "pickle"})
    assert "onnx" in caught.value.remedy


def test_a_model_that_a_run_does_not_keep_is_not_found() -> None:
    """The newest without a number; another one by its number; others with the command that lists them."""
    recipe = Recipe(model="clips", clients=Clients(partitions=2))
    models_ = (Model(number=3), Model(number=5))
    run = RunRecord(id="r", recipe=recipe, models=models_, model=models_[1])
    assert (_kept(run, None).number, _kept(run, 3).number) == (5, 3)
    with pytest.raises(NotFoundError, match="keeps no model 4"):
        _kept(run, 4)
