"""Write the tables of topics, verbs and records into `docs/keyspace.md`, so that it cannot fall behind them.

Each table stands between `<!-- NAME -->` and `<!-- end -->`; the text around them is written by hand.

Usage: write_keyspace.py [--check]
"""

import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from msgspec import Struct

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from appliance import model  # noqa: E402 - a script finds the project beside itself
from appliance.model import keyspace  # noqa: E402 - as above
from appliance.model.keys import Roles, Topic, Verb  # noqa: E402 - as above
from appliance.model.roles import Role  # noqa: E402 - as above
from workshop.robots.world import WORLD, WORLD_OF  # noqa: E402 - as above

TARGET = ROOT / "docs" / "keyspace.md"


def topics() -> str:
    """All topics, those of the simulated world last."""
    everywhere: tuple[Topic[Any], ...] = (*keyspace.TOPICS, WORLD_OF, WORLD)
    rows = [
        (f"`{topic.text}`", "never put" if topic.form == "log" else topic.form, topic.shown, topic.writer,
         _access(topic), topic.often, topic.kept)
        for topic in everywhere
    ]  # fmt: skip
    return _table(
        ("key (below `swiftbot/{fleet}/`)", "form", "payload", "who speaks", "roles", "how often", "kept"), rows
    )


def verbs(*, exchange: bool) -> str:
    """The verbs that are published as exchanges, or those of the plane, which are not."""
    chosen: Iterable[Verb[Any, Any]] = (verb for verb in keyspace.VERBS if verb.exchange is exchange)
    rows = [
        (f"`{verb.name}`", _shown(verb.request), _shown(verb.reply), f"{verb.timeout_s:g} s", _asked_by(verb),
         verb.meaning)
        for verb in chosen
    ]  # fmt: skip
    return _table(("verb", "request", "reply", "waits", "asked by", "meaning"), rows)


def records() -> str:
    """The kinds of records that gateways write."""
    rows = [(f"`{kind.text}`", kind.value, kind.writer, kind.removed) for kind in keyspace.RECORD_KINDS]
    return _table(("key of a record", "value", "written by", "removed"), rows)


def _access(topic: Topic[Any]) -> str:
    """What roles do at a topic."""
    does = (("puts", topic.puts), ("reads", topic.reads), ("answers", topic.answers), ("asks", topic.asks))
    return "; ".join(f"{what}: {_roles(roles)}" for what, roles in does if roles) or "nobody"


def _asked_by(verb: Verb[Any, Any]) -> str:
    """Who may ask a verb, and whether the request is signed."""
    return f"{_roles(verb.asks)}{'; signed' if verb.signed else ''}"


def _roles(roles: Roles) -> str:
    """Roles in the order of their table, `all` where there is none without."""
    return "all" if roles == frozenset(Role) else ", ".join(role for role in Role if role in roles) or "nobody"


def _shown(kind: type[Struct]) -> str:
    """Return the name of a struct; with its fields where docs/schemas has no schema of it."""
    if hasattr(model, kind.__name__):
        return kind.__name__
    return f"{kind.__name__} `{{{', '.join(kind.__struct_fields__)}}}`"


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = tuple(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def page(text: str) -> str:
    """Return the page with new tables."""
    tables = {
        "topics": topics(),
        "plane verbs": verbs(exchange=False),
        "verbs": verbs(exchange=True),
        "records": records(),
    }
    for name, table in tables.items():
        pattern = rf"(<!-- {name} -->\n)(?:\|[^\n]*\n)*(<!-- end -->)"
        text = re.sub(pattern, lambda found, table=table: f"{found[1]}{table}\n{found[2]}", text)
    return text


def main() -> int:
    """Write the page, or with --check say whether it is up to date."""
    text = TARGET.read_text(encoding="utf-8")
    if "--check" in sys.argv:
        return 0 if text == page(text) else 1
    TARGET.write_text(page(text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
