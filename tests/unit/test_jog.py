"""What a held key means."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from appliance.jog import FIRST_S, IDLE_S, LASTS_S, NEXT_S, SEND_S, Holding


def run(holding: Holding, keys: dict[float, str], until: float, step: float = 0.05) -> list[tuple[float, str]]:
    """Press keys at times, ask every `step`, and return what was to be sent, with when."""
    sent: list[tuple[float, str]] = []
    waiting = sorted(keys.items())
    for tick in range(round(until / step)):
        now = tick * step
        while waiting and waiting[0][0] <= now:
            at, move = waiting.pop(0)
            holding.press(move, at)
        what = holding.due(now)
        if what.move:
            sent.append((now, what.move))
        elif what.stop:
            sent.append((now, "stop"))
        elif what.give_back:
            sent.append((now, "give back"))
            break
    return sent


def test_held_key_moves_and_its_release_stops() -> None:
    """While the key repeats the movement is asked for again, each before the last one ends; then there is one stop."""
    keys = {0.0: "forward"} | {0.5 + number / 30: "forward" for number in range(60)}
    sent = run(Holding(0.0), keys, 4.0)
    moves = [at for at, what in sent if what == "forward"]
    assert moves[0] <= 0.05
    assert all(later - earlier < LASTS_S for earlier, later in pairwise(moves))
    stops = [at for at, what in sent if what == "stop"]
    assert len(stops) == 1
    assert stops[0] - max(keys) <= NEXT_S + 0.1


def test_single_press_is_a_short_movement() -> None:
    """A key that is tapped moves until its repeats would have come, no longer."""
    sent = run(Holding(0.0), {0.0: "left"}, 3.0)
    assert [what for _, what in sent if what == "stop"] == ["stop"]
    assert FIRST_S <= sent[-1][0] <= FIRST_S + 0.1


def test_other_direction_is_told_at_once() -> None:
    """A key of another direction takes effect at the next look, without waiting for the interval."""
    holding = Holding(0.0)
    holding.press("forward", 0.0)
    assert holding.due(0.0).move == "forward"
    holding.press("left", 0.05)
    assert holding.due(0.05).move == "left"


def test_release_by_another_key() -> None:
    """A key that is no direction ends the movement at once."""
    holding = Holding(0.0)
    holding.press("forward", 0.0)
    holding.due(0.0)
    holding.release(0.1)
    assert holding.due(0.1).stop
    assert holding.moving == ""


def test_idle_lease_is_given_back() -> None:
    """A terminal from which no key comes, because it is gone or nobody is there, gives the robot back."""
    sent = run(Holding(0.0), {0.0: "forward"}, IDLE_S + 5)
    assert sent[-1][1] == "give back"
    assert IDLE_S <= sent[-1][0] <= IDLE_S + 0.1
    assert [what for _, what in sent].count("stop") == 1


@given(
    gaps=st.lists(st.floats(0.01, 1.5), min_size=1, max_size=40),
    moves=st.lists(st.sampled_from(["forward", "back"]), min_size=40, max_size=40),
)
def test_never_moves_without_a_recent_key(gaps: list[float], moves: list[str]) -> None:
    """However keys come, a movement is asked for only shortly after a key, and every series of them ends in a stop."""
    keys: dict[float, str] = {}
    at = 0.0
    for gap, move in zip(gaps, moves, strict=False):
        at += gap
        keys[at] = move
    sent = run(Holding(0.0), keys, at + 3.0, step=0.02)
    for when, what in sent:
        if what in ("forward", "back"):
            assert any(when - FIRST_S - SEND_S <= key <= when for key in keys)
    assert sent[-1][1] == "stop"
