"""Which log files were written when, from what recorders tell of themselves."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.tasks.retention import MOST_FILES, SLACK_NS, LogFiles

S = 10**9


def test_the_file_of_a_time_is_the_one_its_recorder_wrote_to() -> None:
    """Of each recorder; none where none was heard of; a recorder that waits writes to none."""
    files = LogFiles()
    for at in range(0, 100, 10):
        files.heard("one", "one-1.mcap" if at < 50 else "one-2.mcap", at * S)
    files.heard("two", "two-1.mcap", 90 * S)
    files.heard("three", "", 90 * S)
    assert files.at(20 * S) == "one-1.mcap"
    assert files.at(70 * S) == "one-2.mcap"
    assert files.at(90 * S) == "one-2.mcap, two-1.mcap"
    assert files.at(90 * S + SLACK_NS + 1) == ""
    assert files.at(-S - SLACK_NS) == ""
    assert LogFiles(files.spans).at(20 * S) == "one-1.mcap", "after a restart too"


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 600)), max_size=700))
def test_only_so_many_are_remembered(heard: list[tuple[str, int]]) -> None:
    """However many there are, the newest, and none of them twice in a row."""
    files = LogFiles()
    for number, (recorder, file) in enumerate(heard):
        files.heard(recorder, f"{recorder}-{file}", number * S)
    assert len(files.spans) <= MOST_FILES
    if heard:
        recorder, file = heard[-1]
        assert f"{recorder}-{file}" in files.at((len(heard) - 1) * S)
