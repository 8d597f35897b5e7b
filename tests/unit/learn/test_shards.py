"""Models as shards: what is written is read again, and nothing else passes the check of a file against its manifest."""

import ast
import hashlib
import io
import json
import pickle
import re
import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.skills._lib.learning import shards
from appliance.skills._lib.learning.shards import Manifest, ModelFileError, Piece, Shard, Spec

names = st.from_regex(r"[a-z][a-z0-9_.]{0,12}", fullmatch=True)
shapes = st.lists(st.integers(0, 9), max_size=3).map(tuple)


@st.composite
def models(draw: st.DrawFn) -> dict[str, shards.Array]:
    """Some tensors with values of no meaning."""
    wanted = draw(st.dictionaries(names, shapes, min_size=1, max_size=8))
    seeded = np.random.default_rng(draw(st.integers(0, 2**32)))
    return {name: seeded.normal(size=shape).astype(np.float32) for name, shape in wanted.items()}


def model() -> tuple[Manifest, list[bytes], dict[str, shards.Array]]:
    """A small model in two shards."""
    arrays = {
        "conv.weight": np.arange(600, dtype=np.float32).reshape(60, 10),
        "conv.bias": np.ones(60, dtype=np.float32),
    }
    made = list(shards.split(arrays, shard_bytes=2048))
    return shards.collect(made), [data for _, data in made], arrays


def refused(data: bytes, manifest: Manifest, index: int = 0) -> str:
    """Return the reason for which a shard is refused."""
    with pytest.raises(ModelFileError) as caught:
        shards.decode(data, manifest, index)
    assert caught.value.reason in shards.REASONS
    return caught.value.reason


@contextmanager
def known_reason() -> Generator[None]:
    """Let what is inside succeed, or be refused for one of the reasons that there are."""
    try:
        yield
    except ModelFileError as error:
        if error.reason not in shards.REASONS:
            raise AssertionError(error.reason) from error


def with_file(manifest: Manifest, data: bytes) -> Manifest:
    """Return the manifest as if its first shard had always been `data`: what a liar announces."""
    told = Shard(hashlib.sha256(data).hexdigest(), len(data))
    return manifest._replace(shards=(told, *manifest.shards[1:]))


@given(models(), st.integers(1200, 4000))
@settings(deadline=None)
def test_a_model_comes_back_whole(arrays: dict[str, shards.Array], shard_bytes: int) -> None:
    """Whatever the shapes and the size of shards, the same values come back, through the manifest's JSON too."""
    made = list(shards.split(arrays, shard_bytes=shard_bytes))
    assert all(len(data) <= shard_bytes for _, data in made)
    manifest = shards.parse_manifest(json.loads(json.dumps(shards.collect(made, norm=1.5).to_json())))
    back = shards.join(manifest, [data for _, data in made])
    assert sorted(back) == sorted(arrays)
    for name, array in arrays.items():
        assert np.array_equal(back[name], array)
        assert back[name].dtype == array.dtype
    assert {spec.name: spec.shape for spec in shards.specs(manifest)} == {n: a.shape for n, a in arrays.items()}


@given(models(), st.randoms())
@settings(deadline=None)
def test_equal_models_have_equal_digests(arrays: dict[str, shards.Array], order: Any) -> None:
    """The order in which tensors are given makes no difference to any byte."""
    shuffled = list(arrays.items())
    order.shuffle(shuffled)
    one, other = list(shards.split(arrays)), list(shards.split(dict(shuffled)))
    assert one == other
    assert shards.collect(one).digest == shards.collect(other, norm=2.0).digest


def test_a_tensor_larger_than_a_shard_is_cut_along_its_first_axis() -> None:
    """20 MiB lie in three shards of at most 8 MiB, each part said in the manifest."""
    array = np.arange(20 << 18, dtype=np.float32).reshape(1280, 4096)
    made = list(shards.split({"big": array}))
    manifest = shards.collect(made)
    assert [piece.cut for piece in manifest.pieces] == [(0, 3), (1, 3), (2, 3)]
    assert all(shard.bytes <= shards.SHARD_BYTES for shard in manifest.shards)
    assert np.array_equal(shards.join(manifest, [data for _, data in made])["big"], array)


def test_a_row_larger_than_a_shard_is_refused() -> None:
    """There is nothing to cut along the first axis."""
    with pytest.raises(ModelFileError, match="rows of 12,000,000 bytes"):
        shards.layout([Spec("wide", "F32", (2, 3_000_000))])


@given(st.binary(max_size=400))
def test_no_bytes_break_the_reader(data: bytes) -> None:
    """Any bytes are read, or refused with a reason."""
    with known_reason():
        entries = shards.read_header(data, len(data))
        assert all(0 <= entry.start <= entry.end <= len(data) for entry in entries.values())


@given(st.integers(0, 3000), st.integers(0, 255))
def test_a_damaged_shard_is_refused(at: int, value: int) -> None:
    """Any changed byte is seen by the digest; with a digest that fits, header or values are right or refused."""
    manifest, files, _ = model()
    data = bytearray(files[0])
    at %= len(data)
    if data[at] == value:
        return
    data[at] = value
    assert refused(bytes(data), manifest) == "digest"
    with known_reason():
        arrays = shards.decode(bytes(data), with_file(manifest, bytes(data)), 0)
        assert arrays.keys() == {piece.key for piece in manifest.of_shard(0)}
        assert all(shards.finite(array) for array in arrays.values())


def test_pickles_and_archives_are_refused_unopened() -> None:
    """A pickle and a zip archive, which torch.save writes, are distinguished from a damaged file."""
    manifest, _, _ = model()
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as out:
        out.writestr("data.pkl", pickle.dumps({"conv.weight": [1.0]}))
    for data in (pickle.dumps({"conv.weight": [1.0] * 100}), archive.getvalue()):
        assert refused(data, with_file(manifest, data)) == "format"


def test_a_truncated_shard_is_refused_at_every_length() -> None:
    """Cut anywhere, with a digest that fits what is left."""
    manifest, files, _ = model()
    for size in (*range(9, 300), len(files[0]) - 1):
        data = files[0][:size]
        assert refused(data, with_file(manifest, data)) == "truncated"
    assert refused(files[0][:-1], manifest) == "size"


@pytest.mark.parametrize("length", [2**62, 2**63, 2**64 - 1, shards.MAX_HEADER_BYTES + 1])
def test_a_huge_header_is_refused_by_its_length(length: int) -> None:
    """Eight bytes are enough to refuse it."""
    with pytest.raises(ModelFileError) as caught:
        shards.header_bytes(length.to_bytes(8, "little"), 1 << 30)
    assert caught.value.reason == "header"


def file_of(header: object, data: bytes = b"") -> bytes:
    """Return a file with that header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


@pytest.mark.parametrize(
    ("header", "data"),
    [
        (b"[]", b""),
        (b"{", b""),
        (b"{" + b'"a":[' * 100_000, b""),
        ({"a": 1}, b""),
        ({"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 8]}}, b"12345678"),
        ({"a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}, b"1234"),
        ({"a": {"dtype": "F32", "shape": [2**63, 2**63], "data_offsets": [0, 4]}}, b"1234"),
        ({"a": {"dtype": "F32", "shape": [True], "data_offsets": [0, 4]}}, b"1234"),
        ({"a": {"dtype": "X9", "shape": [1], "data_offsets": [0, 4]}}, b"1234"),
        ({"a": {"dtype": "F32", "shape": [1], "data_offsets": [4, 8]}}, b"12345678"),
        ({"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}, b"12345678"),
        (
            {
                "a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]},
                "b": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]},
            },
            b"1234",
        ),
        (
            b'{"a":{"dtype":"I8","shape":[0],"data_offsets":[0,0]},"a":{"dtype":"I8","shape":[0],"data_offsets":[0,0]}}',
            b"",
        ),
    ],
)
def test_a_header_that_contradicts_itself_is_refused(header: object, data: bytes) -> None:
    """Overlaps, holes, negative and overflowing shapes, doubled names, what is no JSON."""
    file = file_of(header, data)
    with pytest.raises(ModelFileError) as caught:
        shards.read_header(file, len(file))
    assert caught.value.reason in ("header", "format")


def test_ten_thousand_tensors_are_refused() -> None:
    """Empty ones cost no data, and would each be an object."""
    header = {f"t{n}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for n in range(10_000)}
    file = file_of(header)
    with pytest.raises(ModelFileError, match=r"4,096 tensors|header of") as caught:
        shards.read_header(file, len(file))
    assert caught.value.reason == "header"


def test_other_tensors_than_the_models_are_refused() -> None:
    """A name that is missing, one too many, another type, another shape: each with its reason."""
    manifest, files, _ = model()
    good = {key: np.array(array) for key, array in shards.decode(files[0], manifest, 0).items()}
    first = next(iter(good))

    def reason(arrays: dict[str, shards.Array]) -> str:
        data = shards.encode(arrays)
        return refused(data, with_file(manifest, data))

    assert reason({key: array for key, array in good.items() if key != first}) == "missing"
    assert reason({**good, "more": np.zeros(1, np.float32)}) == "extra"
    assert reason({**good, first: good[first].astype(np.int8)}) == "dtype"
    assert reason({**good, first: good[first].reshape(-1, 1)}) == "shape"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(value: float) -> None:
    """One among them all is enough."""
    manifest, files, _ = model()
    arrays = {key: np.array(array) for key, array in shards.decode(files[0], manifest, 0).items()}
    next(iter(arrays.values())).flat[-1] = value
    data = shards.encode(arrays)
    assert refused(data, with_file(manifest, data)) == "nan"
    with pytest.raises(ModelFileError, match="NaN"):
        list(shards.split({"a": np.array([value], dtype=np.float32)}))


def changed(**changes: object) -> dict[str, Any]:
    """Return a manifest's JSON with something else in it."""
    return {**model()[0].to_json(), **changes}


def entry(**changes: object) -> dict[str, Any]:
    """Return a manifest of one tensor with something else in its entry."""
    tensor = {"name": "a", "dtype": "F32", "shape": [4], "shard": 0, "cut": None, **changes}
    return {"format": 1, "tensors": [tensor], "shards": [{"digest": "0" * 64, "bytes": 100}], "norm": None}


@pytest.mark.parametrize(
    ("value", "named"),
    [
        (None, "NoneType"),
        ([], "list"),
        (changed(format=2), "format 2"),
        (changed(tensors=[]), "tensors has 0"),
        (changed(tensors={}), "tensors is no list"),
        (changed(shards=[]), "shards has 0"),
        (changed(norm=float("nan")), "norm"),
        (changed(norm=-1), "norm"),
        (changed(tensors=[model()[0].to_json()["tensors"][0]] * 2), "listed twice"),
        (entry(name="../a"), "name"),
        (entry(name=""), "name"),
        (entry(name="a" * 201), "name"),
        (entry(dtype="F64"), "dtype"),
        (entry(shape=[2**40, 2**40]), "shape"),
        (entry(shape=[-1]), "shape"),
        (entry(shape=[1.5]), "shape"),
        (entry(shape=[1] * 9), "shape"),
        (entry(shard=1), "shard"),
        (entry(cut=[1, 1]), "cut"),
        (entry(cut=[0, 2]), "parts"),
        (entry(shape=[400]), "100 bytes for 1,600"),
        ({**entry(), "shards": [{"digest": "x", "bytes": 100}]}, "digest"),
        ({**entry(), "shards": [{"digest": "0" * 64, "bytes": 2**40}]}, "bytes"),
        ({**entry(), "shards": [{"digest": "0" * 64, "bytes": True}]}, "bytes"),
    ],
)
def test_a_manifest_that_is_none_is_refused(value: object, named: str) -> None:
    """The error names what is wrong."""
    with pytest.raises(ModelFileError, match=named) as caught:
        shards.parse_manifest(value)
    assert caught.value.reason == "manifest"


def test_an_update_has_the_models_tensors() -> None:
    """An update is compared with its model by the two manifests, before any file of it is fetched."""
    manifest, _, arrays = model()
    shards.check_same(manifest, manifest)
    other = shards.collect(list(shards.split({**arrays, "conv.bias": np.ones(61, np.float32)}, shard_bytes=2048)))
    with pytest.raises(ModelFileError, match="expected"):
        shards.check_same(other, manifest)


def test_norms_are_bounded_by_three_medians() -> None:
    """An update ten times as long as the others is refused, one of zeros too; two alone are not compared."""
    bound = shards.norm_bound([1.0, 1.2, 0.9, 10.0])
    assert bound == 3.0
    shards.check_norm(1.2, bound)
    for norm, reason in ((10.0, "norm"), (0.0, "zero"), (float("inf"), "nan")):
        with pytest.raises(ModelFileError) as caught:
            shards.check_norm(norm, bound)
        assert caught.value.reason == reason
    assert shards.norm_bound([1.0, 2.0]) == 6.0


def test_the_norm_is_that_of_all_values() -> None:
    """Over all tensors, in double precision."""
    arrays = [np.full(300_000, 2.0, np.float32), np.array([3.0], np.float32)]
    assert shards.squared_norm(arrays) == 4.0 * 300_000 + 9.0


def test_keys_of_pieces() -> None:
    """A part is called `NAME#k` in its file."""
    assert Piece("a", "F32", (2,), 0).key == "a"
    assert Piece("a", "F32", (2,), 0, (1, 3)).key == "a#1"


def test_no_file_is_read_that_can_run_code() -> None:
    """What comes from elsewhere is safetensors: nothing of the product unpickles, by whatever library."""
    appliance = Path(shards.__file__).parents[3]
    found: list[str] = []
    suspect = re.compile("pickle|dill|joblib|torch.load")
    texts = {path: path.read_text(encoding="utf-8") for path in appliance.rglob("*.py")}
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text)) if suspect.search(text) else ():
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
                found += [f"{path}: {name}" for name in names if name.split(".")[0] in ("pickle", "dill", "joblib")]
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                called = ast.unparse(node.func)
                unsafe = any(
                    each.arg == "allow_pickle" and ast.unparse(each.value) != "False" for each in node.keywords
                )
                found += [f"{path}: {called}"] if called == "torch.load" or unsafe else []
    assert found == []
