"""The screens of the terminal UI; titles and number keys are in `actions.SCREENS`.

Opened from others, and so not in the list: `takeover`, `review` and `submit`.
"""

from appliance.tui.base_screen import FleetScreen
from appliance.tui.screens.fleet import FleetOverview, PoolScreen
from appliance.tui.screens.logs import LogScreen
from appliance.tui.screens.models import LearningScreen, LlmScreen
from appliance.tui.screens.replay import ReplayScreen
from appliance.tui.screens.robots import RobotsScreen
from appliance.tui.screens.tasks import TasksScreen

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
