"""Driving a robot by keys that are held: which movement is requested when. Pure; the clock is passed in.

What keeps it safe when a terminal is lost stands at several places: a movement lasts half a second at the robot, keys
that come no more count as let go, and the lease ends at the gateways when it is not renewed.

Terminals tell of no release: a held key comes again and again, first after the keyboard's delay (a quarter to two
thirds of a second), then some thirty times a second. So for `Holding` the key counts as held for a while after each,
longer after the first, and everything that silences the terminal, a closed window, a cut link, a frozen machine, is a
release as well. The lease itself is renewed only while keys come: an operator who is gone loses it.
"""

from enum import StrEnum

from msgspec import Struct

FIRST_S = 0.7
"""For so long the first press counts as held: beyond the slowest usual delay before a keyboard repeats."""
NEXT_S = 0.25
"""The same for repeats: several of them, so that a jittery link does not make it stutter."""
SEND_S = 0.2
"""How often a movement is requested again; each lasts `LASTS_S` at the robot."""
LASTS_S = 0.5
"""How long a robot goes on with a movement that is not asked for again: two lost messages."""
IDLE_S = 30.0
"""A lease without any key for so long is given back."""


class Step(Struct, frozen=True, kw_only=True):
    """What is to be sent now: a movement, a stop, the lease given back, or nothing."""

    move: str = ""
    """A direction, `""` for none."""
    stop: bool = False
    give_back: bool = False


class Moves(StrEnum):
    """Directions, in the robot's own frame."""

    FORWARD = "forward"
    BACK = "back"
    LEFT = "left"
    RIGHT = "right"
    UP = "up"
    DOWN = "down"
    TURN_LEFT = "turn left"
    TURN_RIGHT = "turn right"


class Holding:
    """Keys of one take-over.

    Args:
        now: the time, seconds of a monotonic clock.
    """

    def __init__(self, now: float) -> None:
        self._move = ""
        self._until = now
        self._sent = float("-inf")
        self._moving = False
        self._last_key = now

    @property
    def moving(self) -> str:
        """The direction that is held, empty when none is."""
        return self._move

    def press(self, move: str, now: float) -> None:
        """Take a press or a repeat of the key of a direction."""
        repeated = move == self._move and now < self._until
        self._until = now + (NEXT_S if repeated else FIRST_S)
        if not repeated:
            self._sent = float("-inf")  # another direction: told at once
        self._move = move
        self._last_key = now

    def release(self, now: float) -> None:
        """Take it that no key is held: another key was pressed, or the window has lost the focus."""
        self._until = min(self._until, now)
        self._last_key = now

    def touch(self, now: float) -> None:
        """Note that the operator is there, without a movement."""
        self._last_key = now

    def due(self, now: float) -> Step:
        """Return what is to be sent now; called some ten times a second."""
        if self._move and now >= self._until:
            self._move = ""
        if self._move:
            if now - self._sent >= SEND_S:
                self._sent = now
                self._moving = True
                return Step(move=self._move)
            return Step()
        if self._moving:
            self._moving = False
            return Step(stop=True)
        return Step(give_back=self.left_s(now) <= 0)

    def left_s(self, now: float) -> float:
        """Return in how many seconds the robot is given back when no key comes."""
        return max(0.0, self._last_key + IDLE_S - now)


TICK_S = 0.05
SPEEDS = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0)
"""Metres a second; the robot's own limit holds besides."""
TURN_DPS = 30.0
GIVE_BACK_S = 3.0
"""How long leaving waits for the robot to be released; beyond it the lease ends by itself."""


def velocity(move: str, speed_mps: float) -> dict[str, float]:
    """Return the arguments of the verb `velocity` for a direction."""
    wanted: dict[str, dict[str, float]] = {
        Moves.FORWARD: {"forward_mps": speed_mps},
        Moves.BACK: {"forward_mps": -speed_mps},
        Moves.LEFT: {"left_mps": speed_mps},
        Moves.RIGHT: {"left_mps": -speed_mps},
        Moves.UP: {"up_mps": speed_mps / 2},
        Moves.DOWN: {"up_mps": -speed_mps / 2},
        Moves.TURN_LEFT: {"turn_dps": TURN_DPS},
        Moves.TURN_RIGHT: {"turn_dps": -TURN_DPS},
    }
    return {"forward_mps": 0.0, "left_mps": 0.0, "up_mps": 0.0, "turn_dps": 0.0} | wanted.get(move, {})
