"""The planner's measurement, and the least that the rules must reach on the development set."""

from pathlib import Path

import pytest

from appliance.errors import NotFoundError, PayloadError
from workshop.bench.plan import run

pytestmark = pytest.mark.anyio


async def test_rules_on_the_development_set() -> None:
    """Rules alone keep their level: good on all cases, nearly right where they are sure enough to be carried out."""
    result = await run()
    assert result["all"]["cases"] == 120
    assert result["all"]["valid"] >= 95
    assert result["all"]["decomposition"] >= 90
    assert result["all"]["parallel_recall"] >= 87
    assert result["taken"]["cases"] >= 60
    assert result["taken"]["decomposition"] >= 96
    assert result["tiers"] == {"rules": sum(result["tiers"].values())}


async def test_cases_that_are_not_there(tmp_path: Path) -> None:
    """A missing set, a missing scorer and a broken line are errors that name the file."""
    with pytest.raises(NotFoundError, match="no cases"):
        await run(tmp_path / "none.jsonl")
    broken = tmp_path / "cases.jsonl"
    broken.write_text('{"id": "a"}\n')
    with pytest.raises(PayloadError, match=r"cases\.jsonl:1"):
        await run(broken)
    broken.write_text("")
    with pytest.raises(NotFoundError, match="no scorer"):
        await run(broken)
