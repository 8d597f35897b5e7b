"""`swiftbot llm …`: language models of gateways. `llm swap` is made from the registry of operations."""

from cyclopts import App

from appliance.cli.common import WORK


def add_to(app: App) -> None:
    """Add this group; its commands follow from the registry."""
    app.command(App(name="llm", help="Swap the language models of gateways.", group=WORK))
