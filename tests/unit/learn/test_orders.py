"""Arguments of the handlers: what is usual, and what cannot be."""

import contextlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.skills._lib.learning import orders
from appliance.skills._lib.learning.orders import Optimiser, OrderError, Part, Rule

REFERENCE = {"artifact": "0" * 64, "bytes": 10}
UPDATE: dict[str, Any] = {"client": "c1", "manifest": {}, "shards": [REFERENCE], "weight": 1024}


def test_a_plan_names_the_model_alone() -> None:
    """All else has a usual value: one epoch on all of the data set that is called as the model."""
    order = orders.training({"model": "clips"}, robot="rover_1")
    assert order.base is None
    assert (order.client, order.data, order.epochs, order.batch, order.speed) == ("rover_1", "clips", 1, None, 1.0)
    assert order.part == Part("even", 0, 1, None)
    assert orders.evaluation({"model": "words"}).split == "test"


def test_a_rounds_arguments() -> None:
    """What a coordinator sends is read whole."""
    order = orders.training(
        {
            "run": "r", "round": 3, "client": "c7", "attempt": 2, "model": "clips",
            "base": {"manifest": {"format": 1}, "shards": [REFERENCE]}, "data": {"folder": "UCF-101"},
            "part": {"by": "site", "index": 2, "of": 16, "indices": [4, 1]}, "epochs": 2, "batch": 8,
            "optimiser": {"name": "adam", "lr": 0.01}, "seed": 2**62, "stop_at_s": 4.5, "speed": 5.0,
            "nominal_batch_s": 0.02, "every_steps": 10, "most_steps": 7,
        },
        robot=None,
    )  # fmt: skip
    assert order.part == Part("site", 2, 16, (4, 1))
    assert order.optimiser == Optimiser("adam", 0.01, 0.0)
    assert order.base is not None
    assert order.base.shards == (REFERENCE,)
    assert (order.data, order.stop_at_s, order.most_steps, order.every_steps) == ("UCF-101", 4.5, 7, 10)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"model": ""}, "model"),
        ({"model": "a/b"}, "model"),
        ({"round": -1}, "round"),
        ({"epochs": 0}, "epochs"),
        ({"epochs": 10**12}, "epochs"),
        ({"epochs": True}, "epochs"),
        ({"epochs": 1.5}, "epochs"),
        ({"batch": 0}, "batch"),
        ({"seed": 2**70}, "seed"),
        ({"seed": "1"}, "seed"),
        ({"stop_at_s": 0}, "stop_at_s"),
        ({"stop_at_s": float("nan")}, "stop_at_s"),
        ({"most_steps": 0}, "most_steps"),
        ({"speed": 0}, "speed"),
        ({"speed": float("inf")}, "speed"),
        ({"data": {"folder": "/etc"}}, "data"),
        ({"data": {"name": "../x"}}, "data"),
        ({"data": {"name": 3}}, "data"),
        ({"data": "clips"}, "data"),
        ({"part": {"of": 0}}, "of"),
        ({"part": {"index": 4, "of": 4}}, "index"),
        ({"part": {"indices": []}}, "part.indices"),
        ({"part": {"indices": [1, 1]}}, "part.indices"),
        ({"part": {"indices": [-1]}}, "part.indices"),
        ({"part": {"by": 3}}, "part.by"),
        ({"optimiser": {"name": "lion"}}, "optimiser.name"),
        ({"optimiser": {"name": "sgd", "lr": float("nan")}}, "lr"),
        ({"optimiser": {"name": "sgd", "momentum": 1.0}}, "momentum"),
        ({"base": {"manifest": {}, "shards": [3]}}, "base.shards[0]"),
        ({"base": {"manifest": {}, "shards": [{}]}}, "base.shards[0]"),
        ({"base": []}, "base"),
    ],
)
def test_what_cannot_be_is_named(change: dict[str, Any], name: str) -> None:
    """A parameter that cannot be is refused with its name and what it may be."""
    with pytest.raises(OrderError) as caught:
        orders.training({"model": "clips"} | change, robot=None)
    assert str(caught.value).startswith(f"{name} is ")
    assert caught.value.remedy.startswith(name)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"updates": []}, "updates"),
        ({"updates": {}}, "updates"),
        ({"updates": [UPDATE | {"weight": 0}]}, "weight"),
        ({"updates": [UPDATE | {"weight": -5}]}, "weight"),
        ({"updates": [UPDATE | {"weight": 10**15}]}, "weight"),
        ({"updates": [UPDATE | {"scale": {"num": 0, "den": 1}}]}, "num"),
        ({"updates": [UPDATE | {"scale": 2}]}, "updates[0].scale"),
        ({"updates": [UPDATE | {"client": ""}]}, "client"),
        ({"updates": [UPDATE, UPDATE | {"weight": 2048}]}, "updates[1].weight"),
        ({"updates": [UPDATE, UPDATE | {"scale": {"num": 2, "den": 1}}]}, "updates[1].weight"),
        ({"rule": {"name": "guess"}}, "rule.name"),
        ({"rule": {"name": "trimmed", "share": 0.5}}, "share"),
        ({"clip": 0}, "clip"),
        ({"classes": 0}, "classes"),
    ],
)
def test_what_cannot_be_in_an_aggregation(change: dict[str, Any], name: str) -> None:
    """Samples of 0, below or beyond all measure, and rules that there are not, are refused by name."""
    with pytest.raises(OrderError) as caught:
        orders.aggregation({"model": "clips", "updates": [UPDATE]} | change)
    assert str(caught.value).startswith(f"{name} is ")


def test_an_aggregations_arguments() -> None:
    """Partial work has a scale, a whole epoch has none; the rule is a mean where none is named."""
    order = orders.aggregation(
        {"model": "clips", "updates": [UPDATE, UPDATE | {"client": "c2", "scale": {"num": 6, "den": 4}}], "clip": 1.5}
    )
    assert [each.scale for each in order.updates] == [(1, 1), (6, 4)]
    assert order.rule == Rule("mean", 0.2, 1)
    assert order.clip == 1.5


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
KEYS = ("run", "round", "client", "model", "base", "data", "part", "epochs", "batch", "optimiser", "seed", "stop_at_s",
        "most_steps", "speed", "every_steps", "updates", "rule", "clip", "classes", "split", "limit")  # fmt: skip


@given(st.dictionaries(st.sampled_from(KEYS), values, max_size=8))
def test_no_parameters_make_it_fail_otherwise(params: dict[str, Any]) -> None:
    """Whatever JSON comes, it is read or refused by name."""
    for read in (lambda p: orders.training(p, robot=None), orders.aggregation, orders.evaluation):
        with contextlib.suppress(OrderError):
            read(params)
