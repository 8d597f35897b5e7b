"""The map of positions."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from appliance.tui.widgets.map import TOO_WIDE, Area, Spot, draw, scale_of, view_of

NUMBERS = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-100, 100)
SPOTS = st.builds(
    Spot,
    name=st.text(min_size=1, max_size=20),
    x=NUMBERS,
    y=NUMBERS,
    online=st.booleans(),
    heading_deg=st.none() | NUMBERS,
    trail=st.lists(st.tuples(NUMBERS, NUMBERS), max_size=4).map(tuple),
)
AREAS = st.builds(
    Area,
    x=st.tuples(NUMBERS, NUMBERS),
    y=st.tuples(NUMBERS, NUMBERS),
    forbidden=st.booleans(),
    one_way=st.sampled_from(("", "north", "east", "south", "west")),
)


def shown(lines: list[object]) -> str:
    """Return the map as text."""
    return "\n".join(getattr(line, "plain", "") for line in lines)


@given(
    robots=st.lists(SPOTS, max_size=12),
    columns=st.integers(1, 60),
    rows=st.integers(2, 20),
    places=st.dictionaries(st.text(max_size=10), st.tuples(NUMBERS, NUMBERS), max_size=4),
    areas=st.lists(AREAS, max_size=4),
)
def test_every_map_fits_its_window(
    robots: list[Spot],
    columns: int,
    rows: int,
    places: dict[str, tuple[float, float]],
    areas: list[Area],
) -> None:
    """Whatever positions, names and window there are, the map has its lines, each as wide as the window."""
    lines = draw(robots, columns, rows, places=places, areas=areas, selected=robots[0].name if robots else "")
    assert len(lines) == rows
    assert all(cell_len(line.plain) == columns for line in lines)


@given(
    points=st.lists(st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)), min_size=1, max_size=20),
    columns=st.integers(3, 100),
    rows=st.integers(3, 50),
)
def test_every_point_is_in_the_view(points: list[tuple[float, float]], columns: int, rows: int) -> None:
    """All points fall within the window."""
    view = view_of(points, columns, rows)
    for x, y in points:
        column, up = view.dot(x, y)
        assert 0 <= column < columns * 2
        assert 0 <= up < rows * 4


def test_robots_stand_as_they_do_on_the_ground() -> None:
    """East is right, north is up; an arrow shows the heading, a cross one that is offline."""
    lines = draw(
        [
            Spot(name="west", x=0, y=0, heading_deg=90),
            Spot(name="north", x=5, y=10, heading_deg=0),
            Spot(name="east", x=10, y=0, online=False),
        ],
        60,
        16,
    )
    text = [line.plain for line in lines]
    row = {name: next(index for index, line in enumerate(text) if name in line) for name in ("west", "north", "east")}
    assert row["north"] < row["west"] == row["east"]
    ground = text[row["west"]]
    assert ground.index("→") < ground.index("✘")
    assert "↑" in text[row["north"]]


def test_robots_together_are_counted() -> None:
    """Robots in one cell are drawn as their number, with the name of the selected one and how many more."""
    robots = [Spot(name=f"r{number}", x=0, y=0) for number in range(5)] + [Spot(name="far", x=50, y=50)]
    text = shown(list(draw(robots, 60, 16, selected="r3")))
    assert "5r3 +4" in text
    assert "far" in text


def test_scale_is_round() -> None:
    """The scale is 1, 2 or 5 times a power of ten, and at most a third of the window."""
    for metres in (0.001, 0.013, 0.5, 3.3, 1234.0):
        for cells in (10, 40, 120):
            length, width = scale_of(metres, cells)
            digit = length / 10 ** math.floor(math.log10(length) + 1e-9)
            assert round(digit) in (1, 2, 5)
            assert 1 <= width <= max(2, cells / 3) + 1


def test_empty_map_says_so() -> None:
    """Without any position the map says why it is empty."""
    assert "no robot tells its position" in shown(list(draw([], 60, 5)))


@given(
    points=st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=1, max_size=8),
    steps=st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), max_size=8),
)
def test_the_view_stands_still_while_it_serves(
    points: list[tuple[float, float]], steps: list[tuple[float, float]]
) -> None:
    """A view is kept as long as all is within it and it is not far too wide; all is within it however it is kept."""
    view = view_of(points, 60, 16)
    for number, (dx, dy) in enumerate(steps):
        at = number % len(points)
        points[at] = (points[at][0] + dx, points[at][1] + dy)
        fresh, before, view = view_of(points, 60, 16), view, view_of(points, 60, 16, view)
        assert all(view.shows(*each) for each in points)
        assert view in (before, fresh)
        assert view.metres <= TOO_WIDE * fresh.metres
    assert view_of(points, 61, 16, view).columns == 61


def test_a_crowd_is_drawn() -> None:
    """Hundreds of robots are signs and numbers, the selected one is named, and the lines still have their width."""
    robots = [Spot(name=f"r{number}", x=number % 25, y=number // 25, trail=((0.0, 0.0),)) for number in range(500)]
    lines = draw(robots, 40, 12, selected="r499")
    assert all(cell_len(line.plain) == 40 for line in lines)
    assert "r499" in shown(list(lines))
    assert all(len(pieces) for pieces in (line.pieces for line in lines))


@pytest.mark.parametrize(("one_way", "arrow"), [("north", "↑"), ("east", "→"), ("south", "↓"), ("west", "←")])
def test_an_aisle_is_drawn_as_arrows(one_way: str, arrow: str) -> None:
    """Along its middle, and nothing else; a robot in it is drawn over them."""
    aisle = Area(x=(0.0, 20.0), y=(0.0, 20.0), one_way=one_way)
    lines = draw((), 40, 21, areas=[aisle])
    drawn = "".join(line.plain for line in lines[:-1]).replace(" ", "")
    assert set(drawn) == {arrow}
    assert len(drawn) > 2
    robot = Spot(name="rover_1", x=10.0, y=10.0)
    assert "rover_1" in "".join(line.plain for line in draw([robot], 40, 21, areas=[aisle]))
