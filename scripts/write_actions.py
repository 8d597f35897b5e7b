"""Write the tables of actions, screens, themes and settings into `docs/tui.md`, so that it cannot fall behind them.

Each table stands between `<!-- NAME -->` and `<!-- end -->`; the text around them is written by hand.

Usage: write_actions.py [--check]
"""

import re
import sys
from collections.abc import Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from write_configuration import fields

from appliance.tui import themes
from appliance.tui.actions import ACTIONS, SCREENS, names

ROOT = Path(__file__).resolve().parent.parent
TARGET = ROOT / "docs" / "tui.md"


def actions() -> str:
    """All actions, as the help of the UI has them."""
    rows = [
        (
            f"`{action.shown}`" if action.keys else "",
            f"`{action.usage}`",
            ", ".join(action.screens) or "everywhere",
            "".join(
                mark
                for mark, holds in (("asks first, ", action.dangerous), ("writes", action.writes and not action.always),
                                    ("always works", action.always))
                if holds
            ),
            action.help,
        )
        for action in ACTIONS
    ]  # fmt: skip
    return _table(("key", "command", "screens", "", "what it does"), rows)


def screens() -> str:
    """The screens with their keys."""
    rows = [(f"`{number}`", title, shows) for number, (title, shows) in enumerate(SCREENS.values(), start=1)]
    return _table(("key", "screen", "what it shows"), rows)


def looks() -> str:
    """The themes."""
    return _table(("theme", "what it is for"), [(f"`{look.name}`", look.help) for look in themes.LOOKS])


def settings() -> str:
    """What a person's own file may set."""
    rows = [
        (f"`{key}`", f"`{default}`", text) for key, _, default, text in fields("appliance.tui.settings", "TuiConfig")
    ]
    return _table(("key", "default", "meaning"), rows)


def keys() -> str:
    """What besides actions can be given other keys."""
    actions = {action.name for action in ACTIONS}
    rows = [(f"`{name}`", f"`{','.join(usual)}`") for name, usual in names().items() if name not in actions]
    return _table(("name", "usual keys"), rows)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = tuple(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(each.replace("|", "\\|") for each in line) + " |" for line in lines)


def page(text: str) -> str:
    """Return the page with its tables made anew."""
    tables = {
        "actions": actions(), "screens": screens(), "themes": looks(), "settings": settings(), "keys": keys(),
    }  # fmt: skip
    for name, table in tables.items():
        pattern = rf"(<!-- {name} -->\n)(?:\|[^\n]*\n)*(<!-- end -->)"
        text = re.sub(pattern, lambda found, table=table: f"{found[1]}{table}\n{found[2]}", text)
    return text


def main() -> int:
    """Write the page, or with --check say whether it is up to date."""
    text = TARGET.read_text()
    if "--check" in sys.argv:
        return 0 if text == page(text) else 1
    TARGET.write_text(page(text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
