"""Configuration of what plans may do, and what an operator has to agree to first."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from appliance.errors import ConfigError

Pattern = Annotated[str, Meta(min_length=1, max_length=100)]


class RobotLimits(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What certain robots may not do. All that match a robot hold for it, the strictest of each kind."""

    robots: tuple[Pattern, ...]
    """Shell patterns of robot ids, such as `drone_*`."""
    altitude_m: Annotated[float, Meta(ge=0)] | None = None
    """A plan that says more, or names a place that lies higher, is refused; a skill's usual take-off is lowered."""
    speed_mps: Annotated[float, Meta(gt=0)] | None = None
    """A plan that says more is refused; what a skill or robot would choose is lowered when the order is sent."""
    duration_s: Annotated[float, Meta(gt=0)] | None = None
    """A plan that says more is refused, and one that says none where the skill's usual time is above it or unknown."""
    skills_never: tuple[Pattern, ...] = ()
    """Shell patterns of skills."""
    places_never: tuple[Pattern, ...] = ()
    """Shell patterns of place names, lower case."""


class SafetyConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The safety policy: it can only tighten what roster, catalogue and site allow, of handed-in plans too."""

    skills_never: tuple[Pattern, ...] = ()
    """Shell patterns of skills that no plan may have."""
    places_never: tuple[Pattern, ...] = ()
    """Shell patterns of names (lower case) of places, areas and objects that no plan may send a robot to, beside the
    site's forbidden areas."""
    exclusive_places: tuple[Pattern, ...] = ()
    """Shell patterns of place names where only one robot may be at a time: a plan has to order their visits."""
    limits: tuple[RobotLimits, ...] = ()
    """Of single robots. An unnamed robot is held to the strictest that could be chosen."""
    robot_tasks: Literal["any", "own", "never"] = "any"
    """Whom a task that a robot asks for may command: `any` robot, only itself (`own`), or nobody (`never`)."""
    grounded: bool = True
    """Refuse a model's plan that names a robot, place, object or text of which the instruction says nothing: neither
    invention nor what was slipped into names and notes of robots becomes a subtask."""
    choose_robot: Literal["ask", "auto"] = "ask"
    """What becomes of an order that names no robot where several can do it: `ask` holds the plan until an operator
    approves the choice, `auto` lets the scheduler choose. Where only one robot can do it, that one does."""
    confirm_skills: tuple[Pattern, ...] = ()
    """Shell patterns of skills with which every plan waits until an operator agrees, such as `cut`."""

    def check(self) -> None:
        """Check what types cannot tell; ConfigError names the key."""
        for number, limits in enumerate(self.limits):
            if not limits.robots:
                raise ConfigError(f"safety.limits[{number}].robots is empty", remedy='give patterns of ids, or "*"')
        for key in ("places_never", "exclusive_places"):
            for each in getattr(self, key):
                if each != each.lower():
                    raise ConfigError(f"safety.{key}: {each!r}", remedy="write names in lower case")
