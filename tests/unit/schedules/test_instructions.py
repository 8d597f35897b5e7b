"""Parameters of saved instructions."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.schedules.instructions import Parameter, filled, parameters, read_values

TEXT = "{robot=rover_1}: fetch {thing} from {place=dock 1}, then go to {place}"


def test_parameters_are_what_stands_in_braces() -> None:
    """Each once, in their order, with the default that one of them gives."""
    assert parameters(TEXT) == (Parameter("robot", "rover_1"), Parameter("thing"), Parameter("place", "dock 1"))
    assert parameters("go to dock 1") == ()


def test_values_stand_in_their_places() -> None:
    """Defaults where none is given; a value is text, whatever it looks like."""
    assert filled(TEXT, {"thing": "the box"}) == "rover_1: fetch the box from dock 1, then go to dock 1"
    assert (
        filled(TEXT, {"thing": r"\1 \g<0>", "place": "bay 2"})
        == r"rover_1: fetch \1 \g<0> from bay 2, then go to bay 2"
    )


@pytest.mark.parametrize("text", ["{", "}", "{}", "{A}", "{a b}", "{a{b}}", "{1}", "go {a=1} {a=2}", "{{a}}"])
def test_a_brace_that_is_no_parameter_is_refused(text: str) -> None:
    """When it is saved, and not when it is run at night."""
    with pytest.raises(PayloadError) as refused:
        parameters(text)
    assert refused.value.remedy


@pytest.mark.parametrize(
    ("values", "says"),
    [({}, "no value for thing"), ({"thing": "x", "plase": "y"}, "no parameter 'plase'"), ({"thing": " "}, "thing"),
     ({"thing": "{place}"}, "braces"), ({"thing": "a\nb"}, "line"), ({"thing": "x" * 201}, "200")],
)  # fmt: skip
def test_values_that_cannot_be_are_refused(values: dict[str, str], says: str) -> None:
    """With the parameters there are."""
    with pytest.raises(PayloadError, match=says):
        filled(TEXT, values)


@given(st.text(max_size=60), st.dictionaries(st.text(max_size=5), st.text(max_size=10), max_size=3))
def test_no_text_breaks_it(text: str, values: dict[str, str]) -> None:
    """What is filled in has no parameter left."""
    with contextlib.suppress(PayloadError):
        assert parameters(filled(text, values)) == ()


def test_values_are_read_as_they_are_typed() -> None:
    """`=` may stand in a value; a name given twice and a word without `=` are errors."""
    assert read_values(["place=dock 2", "note=a=b"]) == {"place": "dock 2", "note": "a=b"}
    for words in (["place"], ["a=1", "a=2"]):
        with pytest.raises(PayloadError):
            read_values(words)
