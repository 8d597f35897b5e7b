"""How much of an instruction an answer says."""

from appliance.llm.decoder import covered
from appliance.llm.words import words_of


def test_words_that_are_pointed_at_count_once() -> None:
    """Runs may overlap and come again; articles, marks and the robots of the roster do not count."""
    words = words_of("Rex, fetch the red drill from bay 2.", ["rex"])
    fetch = ["manipulation", "goto", "w0", "w0", "place:", "w7", "w8", "|", "pick", "w0", "w0", "object:", "w3", "w5"]
    assert covered(fetch, words) == 5  # Rex, bay, 2, red, drill
    assert covered([*fetch, "<", "1"], words) == 5
    assert covered(["manipulation", "pick", "w10", "w10", "object:", "w3", "w5"], words) == 2
    assert covered(["none", "chatter"], words) == 0


def test_what_is_no_run_is_survived() -> None:
    """A lone word at the end, and a run that goes backwards, which the reader refuses, count nothing."""
    words = words_of("go to dock 3")
    assert covered(["goto", "any", "place:", "w3", "w2"], words) == 0
    assert covered(["goto", "w2"], words) == 0
