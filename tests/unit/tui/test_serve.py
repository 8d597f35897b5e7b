"""Who may open the terminal UI in a browser."""

from importlib import resources

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError
from appliance.tui.serve import SCRIPT, Guard, make_token, page

TOKEN = "a-good-token-of-length"  # noqa: S105 - of this test alone
PLAIN = {"Host": "127.0.0.1:8000"}


@pytest.fixture
def guard() -> Guard:
    """Return a guard of port 8000."""
    return Guard(TOKEN, 8000)


def test_owner_is_let_in(guard: Guard) -> None:
    """A browser that knows the token and asks for this machine by its own name is let in, by HTTP and WebSocket."""
    for host in ("127.0.0.1:8000", "localhost:8000", "[::1]:8000", "LOCALHOST:8000"):
        assert guard.refusal({"host": host}, given=TOKEN, socket=False) == ""
        assert guard.refusal({"Host": host, "Origin": f"http://{host.lower()}"}, given=TOKEN, socket=True) == ""
    assert guard.refused == {}


@pytest.mark.parametrize("given_token", [None, "", "x", TOKEN[:-1], TOKEN + "x", TOKEN.upper(), "ü" * 22])
def test_token_is_required(guard: Guard, given_token: str | None) -> None:
    """Without the very token nobody is let in, and it is counted."""
    assert "token" in guard.refusal(PLAIN, given=given_token, socket=False)
    assert sum(guard.refused.values()) == 1


@pytest.mark.parametrize(
    "host", ["evil.example:8000", "127.0.0.1:8001", "127.0.0.1", "", "127.0.0.1:8000.evil.example"]
)
def test_other_names_are_turned_away(guard: Guard, host: str) -> None:
    """A name that was made to point here is no name of this machine: a page of it is turned away, token or not."""
    assert "own name" in guard.refusal({"Host": host}, given=TOKEN, socket=False)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:8000", "http://localhost:8000"])
def test_other_pages_are_turned_away(guard: Guard, origin: str) -> None:
    """A request that another page makes is turned away even where the browser sends the cookie along."""
    assert "another page" in guard.refusal(PLAIN | {"Origin": origin}, given=TOKEN, socket=True)


def test_socket_must_tell_its_page(guard: Guard) -> None:
    """Browsers always tell the origin of a WebSocket: what tells none is no browser of ours."""
    assert guard.refusal(PLAIN, given=TOKEN, socket=True)
    assert guard.refusal(PLAIN | {"Sec-Fetch-Site": "cross-site"}, given=TOKEN, socket=False)
    assert guard.refusal(PLAIN | {"Sec-Fetch-Site": "none"}, given=TOKEN, socket=False) == ""


@pytest.mark.parametrize("token", ["", "short", "x" * 15, "with space in the token", "semi;colon;semi;colon", "ü" * 20])
def test_weak_tokens_are_refused(token: str) -> None:
    """A token that is short or no cookie carries is refused with what is needed."""
    with pytest.raises(ConfigError) as caught:
        Guard(token, 8000)
    assert "16" in caught.value.remedy


def test_made_tokens_differ() -> None:
    """Made tokens are good enough for the guard and never the same."""
    assert Guard(make_token(), 1).knows(make_token()) is False


@given(host=st.text(max_size=60), given_token=st.none() | st.text(max_size=60), socket=st.booleans())
def test_guessing_does_not_help(host: str, given_token: str | None, socket: bool) -> None:
    """Whatever is sent without the token is refused, and nothing breaks."""
    guard = Guard(TOKEN, 8000)
    if given_token != TOKEN:
        assert guard.refusal({"Host": host, "Origin": host}, given=given_token, socket=socket)


def test_page_loads_nothing_from_elsewhere() -> None:
    """The page names no other machine, and what is put into it cannot break out of it."""
    text = page('<script>alert("x")</script>', "127.0.0.1:8000")
    assert "<script>alert" not in text
    assert "https:" not in text
    assert "//127.0.0.1:8000/ws" in text


def test_keys_reach_the_terminal_without_a_click() -> None:
    """The page gives the keyboard to the field that the terminal's own script makes: F8 must work at once."""
    script = (resources.files("textual_serve") / "static/js/textual.js").read_text()
    assert "xterm-helper-textarea" in script
    assert 'querySelector(".xterm-helper-textarea")' in SCRIPT
    assert "focus()" in SCRIPT
