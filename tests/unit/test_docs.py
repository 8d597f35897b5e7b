"""The documentation points at what there is."""

import re
from pathlib import Path

import pytest

from scripts import write_plots

LINK = re.compile(r"\[[^\]]+\]\(([^)#\s]+)(?:#[^)]*)?\)")


ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    "page", [str(page.relative_to(ROOT)) for page in (*ROOT.glob("*.md"), *sorted(ROOT.glob("docs/**/*.md")))]
)
def test_links_lead_to_files(project_root: Path, page: str) -> None:
    """Each link of a page that is no address leads to a file of the project."""
    at = project_root / page
    links = [each for each in LINK.findall(at.read_text()) if "://" not in each]
    assert [each for each in links if not (at.parent / each).exists()] == []


def test_the_table_of_changes_names_what_the_files_have(project_root: Path) -> None:
    """Each name in "Where to change things" is in the file whose link follows it; nothing takes more than 3 steps."""
    page = project_root / "docs" / "architecture.md"
    section = page.read_text().partition("## Where to change things")[2].partition("\n## ")[0]
    table = {line.split("|")[1]: line.split("|")[2] for line in section.splitlines() if line.startswith("|")}
    subjects = " ".join(table)
    for subject in ("MigCost", "eviction", "gateway dies", "key", "verb", "setting", "skill", "MAVLink", "command",
                    "screen"):  # fmt: skip
        assert subject in subjects, subject
    for row in list(table.values())[2:]:
        assert len(re.findall(r"(?<!\w)\d\. ", row)) <= 3
        for step in re.split(r"; \d\. ", row):
            for name, link in re.findall(r"`@?(\w+)`[^`\[\]]*\[[^\]]+\]\(([^)]+\.py)\)", step):
                assert re.search(rf"\b{name}\b", (page.parent / link).read_text()), (name, link)


@pytest.mark.parametrize("name", write_plots.PLOTS)
def test_plots_show_the_results(project_root: Path, name: str) -> None:
    """Each is what `scripts/write_plots.py` makes of the results as they are, and stands in docs/benchmarks.md."""
    assert (project_root / "docs" / "plots" / f"{name}.svg").read_text() == write_plots.drawn(write_plots.PLOTS[name])
    assert f"(plots/{name}.svg)" in (project_root / "docs" / "benchmarks.md").read_text()
