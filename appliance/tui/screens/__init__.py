"""The screens of the terminal UI; titles and number keys are in `actions.SCREENS`.

Those of the fleet, the pool and the planner are here; tasks, robots, the log and replay have rooms of their own.
"""

from appliance.tui.frame import FleetScreen
from appliance.tui.logs.screen import LogScreen
from appliance.tui.replay.screen import ReplayScreen
from appliance.tui.robots.screen import RobotsScreen
from appliance.tui.screens.fleet import FleetOverview
from appliance.tui.screens.learning import LearningScreen
from appliance.tui.screens.llm import LlmScreen
from appliance.tui.screens.pool import PoolScreen
from appliance.tui.tasks.screen import TasksScreen

SCREENS: dict[str, type[FleetScreen]] = {
    "fleet": FleetOverview,
    "tasks": TasksScreen,
    "robots": RobotsScreen,
    "pool": PoolScreen,
    "llm": LlmScreen,
    "learning": LearningScreen,
    "log": LogScreen,
    "replay": ReplayScreen,
}
"""By the name that their action has."""
