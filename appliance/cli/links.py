"""How MAVLink links are shown to people."""

from collections.abc import Mapping

from rich.console import Group
from rich.table import Table

from appliance.robots.api import LinkFacts, LinkList


def links_tables(found: Mapping[str, LinkList]) -> Group:
    """Return a table of the links, one of their senders, and one of the routes."""
    links = Table("gateway", "link", "ends", "in/s", "out/s", "B/s in", "latency ms", "refused", "", box=None)
    senders = Table("gateway", "link", "sender", "frames", "lost", "loss", "late", "repeated", "silent s", box=None)
    routes = Table("gateway", "sender", "was heard last on", box=None)
    for name, each in sorted(found.items()):
        for link in each.links:
            links.add_row(name, link.url, str(len(link.ends)), *_figures(link), _note(link))
            for one in link.senders:
                senders.add_row(
                    name, link.url, f"{one.system}/{one.component}", f"{one.received:,}", f"{one.lost:,}",
                    f"{one.loss:.1%}", str(one.late), str(one.repeated), f"{one.silent_s:g}",
                )  # fmt: skip
        for sender, where in each.routes.items():
            routes.add_row(name, sender, where)
    return Group(*(each for each in (links, senders, routes) if each is links or each.row_count))


def _figures(link: LinkFacts) -> tuple[str, str, str, str, str]:
    refused = sum(link.refused.values())
    latency = ", ".join(f"{each.mean_ms:.1f}" for each in link.latency) or "–"
    return f"{link.in_hz:,.0f}", f"{link.out_hz:,.0f}", f"{link.in_bytes_s:,.0f}", latency, f"{refused:,}"


def _note(link: LinkFacts) -> str:
    """Return what else is to be said of a link."""
    said = ["listens" if link.listens else "connects"]
    if link.signed:
        said.append("signed")
    if link.added:
        said.append("added at run time")
    if link.problem:
        said.append(link.problem)
    said += [f"a storm of {each} is damped" for each in link.damped]
    return ", ".join(said + [f"{kind} {count}" for kind, count in sorted(link.refused.items())])
