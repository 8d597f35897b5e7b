"""The screen of federated learning: its rounds, once there are any."""

from rich.text import Text
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.tui.frame import FleetScreen
from appliance.tui.keys import bindings
from appliance.tui.store import Store


class LearningScreen(FleetScreen):
    """Rounds of federated learning."""

    scope = "learning"
    shows = ("asked",)
    BINDINGS = bindings("learning")
    DEFAULT_CSS = """
    LearningScreen #empty { padding: 1 2; }
    """

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Static(id="empty")

    def draw_body(self, store: Store) -> None:
        """Say that there are none."""
        _ = store
        self.query_one("#empty", Static).update(
            Text(
                "No rounds: this fleet has no federated learning.\n\n"
                "A gateway of this version runs no rounds and tells of none, so there is nothing that could be shown "
                "here. `swiftbot train` trains a gateway's own language model on one machine."
            )
        )
