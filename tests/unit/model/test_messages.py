"""Enumerations, and the words of newer versions."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import ContainerState, SubtaskState, TaskRecord, TaskState, encode
from appliance.model.messages import enums_open

RECORD = encode(TaskRecord(id="t", instruction="x"))


def told(state: str) -> bytes:
    """Return a record in a state."""
    return encode(msgspec.json.decode(RECORD) | {"state": state})


def test_an_unknown_word_is_refused_by_whoever_decides() -> None:
    """A record in a state that this version does not know is malformed, before and after somebody had them kept."""
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(told("dreaming"), type=TaskRecord)
    with enums_open():
        msgspec.json.decode(told("dreaming"), type=TaskRecord)
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(told("dreaming"), type=TaskRecord)


@given(word=st.text(max_size=200))
def test_an_unknown_word_is_kept_by_whoever_shows(word: str) -> None:
    """It is itself, as far as it is not endless, equal to no known word, not final, and encoded as it came."""
    with enums_open():
        record = msgspec.json.decode(told(word), type=TaskRecord)
    assert str(record.state) == word[:100]
    if word not in set(TaskState):
        assert record.state not in tuple(TaskState)
        assert not record.state.final
        assert msgspec.json.decode(encode(record))["state"] == word[:100]


@pytest.mark.parametrize("kind", [TaskState, SubtaskState, ContainerState])
def test_known_words_are_the_members(kind: type[TaskState]) -> None:
    """While unknown words are kept, a known one is still the one member of that word; what is no text is refused."""
    with enums_open():
        for member in kind:
            assert msgspec.json.decode(encode(str(member)), type=kind) is member
        with pytest.raises(msgspec.ValidationError):
            msgspec.json.decode(b"3", type=kind)
    assert len(kind) == len(set(kind))
