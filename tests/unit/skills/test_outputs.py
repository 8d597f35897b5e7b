"""Results against what manifests promise: whatever a handler returns is judged, never met with an exception."""

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from appliance.skills.catalogue import SHOWN, Output, SkillManifest, broken_promises, load_catalogue

GOOD: dict[str, st.SearchStrategy[Any]] = {
    "string": st.text(max_size=5),
    "number": st.one_of(st.integers(), st.floats(allow_nan=False)),
    "integer": st.one_of(st.integers(), st.integers(-1000, 1000).map(float)),
    "boolean": st.booleans(),
    "array": st.lists(st.integers(), max_size=2),
    "object": st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
    "any": st.one_of(st.booleans(), st.text(max_size=3), st.lists(st.none(), max_size=1)),
}
NAMES = st.sampled_from(["number", "count", "found", "where"])
OUTPUTS = st.dictionaries(NAMES, st.builds(Output, type=st.sampled_from(sorted(GOOD)), required=st.booleans()))
ANY_VALUE = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=80)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=5,
)


def manifest(outputs: dict[str, Output], produces: tuple[str, ...] = ()) -> SkillManifest:
    """Return a skill that promises this."""
    return SkillManifest(
        id="look", domain="any", summary="looks", runs="compute", image="base", results=outputs, produces=produces
    )


@given(OUTPUTS, st.data())
def test_a_result_that_is_as_promised_passes(outputs: dict[str, Output], data: st.DataObject) -> None:
    """Optional values may be there, null or left out."""
    result: dict[str, Any] = {"more": 1}
    for name, output in outputs.items():
        if output.required or data.draw(st.booleans()):
            result[name] = data.draw(GOOD[output.type])
        elif data.draw(st.booleans()):
            result[name] = None
    assert broken_promises(manifest(outputs), result) == ()


@given(OUTPUTS, st.dictionaries(st.one_of(NAMES, st.text(max_size=60)), ANY_VALUE, max_size=5))
def test_whatever_comes_is_judged_in_one_sentence_for_each_output(
    outputs: dict[str, Output], result: dict[str, Any]
) -> None:
    """Each names the output, what is expected and what came, and none is longer than a line."""
    problems = broken_promises(manifest(outputs), result)
    assert len(problems) <= len(outputs)
    for problem in problems:
        assert any(repr(name) in problem for name in outputs)
        assert "expected " in problem
        assert "got " in problem
        assert len(problem) < 200 + 10 * 4 * SHOWN
    for name, output in outputs.items():
        if output.required and result.get(name) is None:
            assert any(f"{name!r} is missing" in problem for problem in problems)


def test_what_a_skill_produces_is_what_its_result_holds() -> None:
    """A kind of data has a type; `results` may give another, and may say that it can be missing."""
    assert broken_promises(manifest({}, ("number", "heat")), {"heat": [1]}) == (
        "output 'number' is missing: expected a number, got a result with 'heat'",
    )
    optional = {"number": Output(type="string", required=False)}
    assert broken_promises(manifest(optional, ("number",)), {}) == ()
    assert broken_promises(manifest(optional, ("number",)), {"number": 3}) == (
        "output 'number' has the wrong type: expected a text, got the number 3",
    )


def test_the_built_in_skills_promise_what_later_ones_read() -> None:
    """`count` has a number, `detect` has detections: the manifests say so."""
    skills = load_catalogue().skills
    assert skills["count"].outputs["number"].type == "number"
    assert skills["detect"].outputs["detections"].type == "array"
    assert not skills["goto"].outputs
