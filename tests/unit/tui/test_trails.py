"""Where robots came from."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Pose, RobotInfo
from appliance.tui.robot_view import MOST_SHOWN, MOST_TRAILS, TRAIL, Trails, shown_of


@given(at=st.lists(st.integers(0, 3), max_size=200), most=st.integers(1, 80))
def test_the_last_positions_are_remembered(at: list[int], most: int) -> None:
    """Positions stand in order, one like the last once, and no more of them than are wanted and remembered."""
    trails, wanted = Trails(), list[tuple[float, float]]()
    for x in at:
        trails.note([RobotInfo(id="r", kind="zenoh", pose=Pose(x=float(x)))])
        if not wanted or wanted[-1][0] != x:
            wanted.append((float(x), 0.0))
    assert trails.last("r", most) == tuple(wanted[-TRAIL:][-most:])


def test_trails_are_bounded() -> None:
    """Only so many robots leave a trail, each shorter the more there are, and one without a position none."""
    trails = Trails()
    robots = [RobotInfo(id=f"r{number}", kind="zenoh", pose=Pose(x=1.0)) for number in range(MOST_TRAILS + 5)]
    trails.note([*robots, RobotInfo(id="nowhere", kind="zenoh")])
    assert sum(bool(trails.last(each.id, 9)) for each in robots) == MOST_TRAILS
    assert trails.last("nowhere", 9) == ()
    for count in (0, 1, 500, 10**6):
        assert shown_of(count) >= 1
        assert shown_of(count) == 1 or count * shown_of(count) <= MOST_SHOWN
