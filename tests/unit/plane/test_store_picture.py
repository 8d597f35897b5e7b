"""The committed records in memory say what the file says, or that they do not know."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.model.plane_api import Record
from appliance.plane.store import Picture

_KEYS = st.sampled_from(["a", "b", "c", "d"])
_STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("put"), _KEYS, st.integers(0, 900)),
        st.tuples(st.just("drop"), _KEYS, st.just(0)),
        st.tuples(st.just("look"), _KEYS, st.just(0)),
        st.tuples(st.just("read"), _KEYS, st.just(0)),
    ),
    max_size=60,
)


def _record(key: str, size: int, count: int) -> Record:
    return Record(key=key, value=b"x" * size, version={"a": count})


@given(_STEPS, st.integers(400, 3000))
def test_it_never_says_what_is_not_so(steps: list[tuple[str, str, int]], most: int) -> None:
    """Whatever is put, dropped, read and pushed out for room: an answer is the file's, and room is kept to."""
    file: dict[str, Record] = {"a": _record("a", 10, 1)}
    picture = Picture(file, most_bytes=most)
    for count, (what, key, size) in enumerate(steps, 2):
        if what == "put":
            file[key] = _record(key, size, count)
            picture.put(file[key])
        elif what == "drop":
            file.pop(key, None)
            picture.drop(key)
        elif what == "read" and key in file:
            picture.read(file[key])
        for each in "abcd":
            known, record = picture.look(each)
            assert not known or record == file.get(each)
            assert known or each in file
        assert picture._bytes <= most
        assert set(picture._records) <= set(file)


def test_what_was_dropped_is_not_held_by_a_late_read() -> None:
    """A record that was read before its key was dropped is not shown after."""
    picture = Picture(["a"])
    picture.drop("a")
    picture.read(_record("a", 1, 1))
    assert picture.look("a") == (True, None)
