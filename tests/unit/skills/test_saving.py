"""Long skills save what they have done: a run that is left goes on elsewhere from there, and ends the same."""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

from appliance.skills.catalogue import SKILLS, load_catalogue

Make = Callable[..., Any]
Load = Callable[..., ModuleType]
Leave = Callable[..., dict[str, Any]]
LONG = ("patrol", "find", "record_video")


def test_they_say_so_in_their_manifests() -> None:
    """A move waits for their checkpoint, and for the command that is under way."""
    for name in LONG:
        manifest = load_catalogue().skills[name]
        assert manifest.checkpoints
        assert manifest.migratable == "between commands"
        assert "ctx.checkpoint(" in (SKILLS / name / "handler.py").read_text()


@pytest.mark.parametrize("after", [1, 2, 3])
def test_patrol_goes_on_with_the_next_lap(make_ctx: Make, handler: Load, leave: Leave, after: int) -> None:
    """Laps done elsewhere are not done again, and count; after the last one there is nothing left to do."""
    whole = make_ctx(area="rack b", laps=3)
    wanted = handler("patrol").run(whole)
    first, second = make_ctx(area="rack b", laps=3), make_ctx(area="rack b", laps=3)
    second.resume = leave(handler("patrol").run, first, after)
    second.info["pose"] = first.info["pose"]
    result = handler("patrol").run(second)
    assert result["laps"] == 3
    assert len(first.sent("goto")) + len(second.sent("goto")) == 3
    assert result["pose"] == wanted["pose"]
    assert result["path_m"] == pytest.approx(wanted["path_m"], abs=0.1)


def test_a_patrol_for_some_time_counts_the_time_before(make_ctx: Make, handler: Load) -> None:
    """What it took elsewhere is part of the time asked for."""
    ctx = make_ctx(area="rack b", duration_s=60)
    ctx.resume = {"lap": 4, "path_m": 100.0, "pose": {"x": 11.0, "y": 14.0}, "seconds": 61.0}
    result = handler("patrol").run(ctx)
    assert (result["laps"], result["path_m"], ctx.sent("goto")) == (4, 100.0, [])


def test_find_goes_on_with_the_next_view(
    make_ctx: Make, handler: Load, leave: Leave, picture: Callable[..., bytes]
) -> None:
    """Views that showed nothing are not taken again; the points are those about where it began."""
    first, second = make_ctx(target="red box"), make_ctx(target="red box")
    whole = make_ctx(target="red box")
    for each in (first, whole):
        each.info["pose"] = {"x": 16.0, "y": 12.0}
    with pytest.raises(whole.Fail):
        handler("find").run(whole)
    second.resume = leave(handler("find").run, first, 2)
    second.info["pose"] = first.info["pose"]
    with pytest.raises(second.Fail, match=f"from {len(whole.sent('capture'))} points"):
        handler("find").run(second)
    assert len(first.sent("capture")) == 2
    assert first.sent("goto")[:1] + second.sent("goto") == whole.sent("goto")
    third = make_ctx(target="red box")
    third.resume, third.picture = second.resume, picture(("red", (100, 100, 60, 60)))
    found = handler("find").run(third)
    assert (found["views"], found["looked_from"]) == (3, whole.partials[2]["looked_from"])


def test_what_find_tells_so_far_counts_the_views_before_a_move(make_ctx: Make, handler: Load, leave: Leave) -> None:
    """A view that showed nothing is reported at once; the next attempt counts those of the one before as its own."""
    first, second, whole = (make_ctx(target="red box") for _ in range(3))
    for each in (first, whole):
        each.info["pose"] = {"x": 16.0, "y": 12.0}
    with pytest.raises(whole.Fail):
        handler("find").run(whole)
    second.resume = leave(handler("find").run, first, 2)
    second.info["pose"] = first.info["pose"]
    with pytest.raises(second.Fail):
        handler("find").run(second)
    # The second attempt ends the first in the middle of its second view: that is saved, and not told.
    assert first.partials + second.partials == [whole.partials[0], *whole.partials[2:]]
    assert [len(each["looked_from"]) for each in whole.partials] == [each["views"] for each in whole.partials]
    assert not any(each["found"] for each in whole.partials)
