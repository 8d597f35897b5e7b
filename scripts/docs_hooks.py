"""Hooks of the documentation's site: links to files of the project outside docs/ are shown as their paths."""

import re
from pathlib import Path
from typing import Any

LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s:]+)(#[^)\s]*)?\)")


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Return a page's text with links out of docs/ as code; a link to what is not there stays: it is warned of."""
    docs = Path(config["docs_dir"])
    folder = (docs / page.file.src_path).parent

    def shown(link: re.Match[str]) -> str:
        target = (folder / link[2]).resolve()
        inside = docs in target.parents and target.is_file() and docs / "examples" not in target.parents
        if inside or not target.exists():
            return link[0]
        words = link[1].strip("`")
        path = str(target.relative_to(docs.parent))
        return f"`{path}`" if words in (path, link[2]) else f"{link[1]} (`{path}`)"

    return LINK.sub(shown, markdown)
