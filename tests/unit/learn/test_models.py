"""Models as they are described, and the values that a run begins with."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest

from appliance.skills._lib.learning import models, shards
from appliance.skills._lib.learning.models import ModelError, Tensor

SOURCES = Path(models.__file__).resolve().parents[2]


def test_the_shipped_models() -> None:
    """Each has the parameters it is known for, and fits one shard."""
    counts = {name: sum(np.prod(t.shape) for t in models.read(name).tensors(len(models.read(name).classes)))
              for name in models.names()}  # fmt: skip
    assert counts == {"clips": 73_682, "words": 80_060, "sentences": 424_861}
    for name in models.names():
        model = models.read(name)
        specs = [shards.Spec(each.name, "F32", each.shape) for each in model.tensors(len(model.classes))]
        assert shards.layout(specs)[-1].shard == 0


def test_classes_are_a_size() -> None:
    """The number of classes of the data decides the shape of the last layer alone."""
    model = models.read("clips")
    ten, other = (dict(model.tensors(count)) for count in (10, 101))
    assert {name for name in ten if ten[name] != other[name]} == {"head.weight", "head.bias"}
    assert other["head.weight"] == (101, 64)


def test_a_run_begins_alike_everywhere() -> None:
    """The same seed draws the same values; weights, scales and biases begin as they should."""
    tensors = models.read("clips").tensors(10)
    first = models.initial(tensors, 5)
    assert all(np.array_equal(values, models.initial(reversed(tensors), 5)[name]) for name, values in first.items())
    assert not np.array_equal(first["head.weight"], models.initial(tensors, 6)["head.weight"])
    assert (first["norms.0.weight"] == 1).all()
    assert (first["head.bias"] == 0).all()
    assert np.std(first["convolutions.3.weight"]) == pytest.approx((2 / (32 * 27)) ** 0.5, rel=0.02)
    assert not np.array_equal(
        models.initial([Tensor("a", (3, 3))], 1)["a"], models.initial([Tensor("b", (3, 3))], 1)["b"]
    )


GOOD = """
name = "mine"
task = "classify"
input = "clip"
classes = ["A"]
[[tensors]]
name = "w"
shape = ["classes", 4]
"""


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (('"mine"', '"yours"'), "name: 'yours' is not the folder's name"),
        (('"classify"', '"guess"'), "task: 'guess'; possible: classify, transcribe"),
        (('"clip"', '"film"'), "input: 'film'; possible: clip, word, sentence"),
        (('["A"]', '["A", "A"]'), "classes: a list of names, each once"),
        (('["classes", 4]', "[4, -1]"), r"tensors\[0\]\.shape: -1 is no size"),
        (('["classes", 4]', '["width"]'), r"tensors\[0\]\.shape: 'width' is no size"),
        (("shape", "size"), r"tensors\[0\]: name and shape are needed"),
        (("[[tensors]]", "batch = 0\n[[tensors]]"), "batch: a whole number"),
        (("[[tensors]]", "[[layers]]"), "tensors: at least one"),
        (("task", "task = ["), "cannot be read"),
    ],
)
def test_a_wrong_model_is_refused_with_file_and_key(tmp_path: Path, change: tuple[str, str], told: str) -> None:
    """What is wrong in model.toml is reported before any of its code runs."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "model.toml").write_text(GOOD)
    assert models.read("mine", [tmp_path]).tensors(3) == (Tensor("w", (3, 4)),)
    (tmp_path / "mine" / "model.toml").write_text(GOOD.replace(*change))
    with pytest.raises(ModelError, match=told) as caught:
        models.read("mine", [tmp_path])
    assert "model.toml" in str(caught.value)


@pytest.mark.parametrize("name", ["nonsense", "../clips", "", "clips/"])
def test_an_unknown_model_is_refused_with_those_there_are(name: str) -> None:
    """No name leads out of the folders of models."""
    with pytest.raises(ModelError, match="known: clips, sentences, words"):
        models.read(name)


def test_nothing_that_runs_in_a_container_unpickles() -> None:
    """No handler, shared module or model imports pickle, calls torch.load, or has numpy read pickles."""
    forbidden = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve"}
    for file in SOURCES.rglob("*.py"):
        tree = ast.parse(file.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {alias.name.split(".")[0] for alias in node.names}
                names |= {(node.module or "").split(".")[0]} if isinstance(node, ast.ImportFrom) else set()
                assert not names & forbidden, file
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                assert (node.value.id, node.attr) != ("torch", "load"), file
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "load":
                called = ast.unparse(node.func)
                if called == "np.load":
                    assert any(
                        word.arg == "allow_pickle" and ast.unparse(word.value) == "False" for word in node.keywords
                    )
        assert not re.search(r"\b(exec|eval)\(", file.read_text().replace(".eval()", "")), file
