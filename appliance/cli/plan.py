"""Plans and what is learned from them: `swiftbot plan`, `swiftbot skill-stats`."""

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter
from rich.console import Group

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, fields, show
from appliance.errors import ConfigError, Exit
from appliance.estimate import Estimate
from appliance.model.task_api import PlanAnswer
from appliance.operations import estimate_of, estimate_text

if TYPE_CHECKING:
    from appliance.config import GatewayConfig
    from appliance.llm.stop_words import StopRequest
    from appliance.skills.catalogue import Catalogue


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(plan, group=WORK)
    app.command(skill_stats, group=WORK)


class PlanEstimated(PlanAnswer, frozen=True, kw_only=True):
    """A plan, and what it is expected to do."""

    estimate: Estimate


async def plan(
    text: str = "",
    *,
    private: Annotated[
        bool, Parameter(help="Ask no other machine: no other gateway's model, no upstream one.")
    ] = False,
    batch: Annotated[Path | None, Parameter(help="Plan a JSONL file of cases instead, without a fleet.")] = None,
    out: Annotated[Path | None, Parameter(help="File for their predictions; continued if it exists.")] = None,
    tier: Annotated[
        Literal["auto", "local", "upstream", "rules"], Parameter(help="Planner of a batch; auto: all tiers in order.")
    ] = "auto",
    model: Annotated[str, Parameter(help="Folder of the local model, for a batch.")] = "",
    config: Annotated[Path | None, Parameter(help="Gateway's TOML file with [llm] and [safety], for a batch.")] = None,
    site: Annotated[
        str,
        Parameter(help="Site of a batch, with places, objects, fence and limits: name or TOML file."),
    ] = "",
    dry_run: Annotated[
        bool, Parameter(help="Also estimate by the site's map what the plan does: ways, times, places passed, limits.")
    ] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Plan an instruction and print the plan with its constraints; runs nothing.

    --dry-run is an estimate, no simulation: ways as the robots will plan them, at a steady speed, without waits.

    With --batch and --out each case `{"id", "instruction", "robots"?}` gets a line with plan, tier, confidence,
    latency, `decision` (run, hold, refuse, stop) and the checks that spoke. Ctrl-C keeps what is written, and the same
    command continues. Lines that are no case are listed with their numbers and end the command with exit code 4.
    """
    if batch is not None or out is not None:
        if batch is None or out is None or text:
            raise ConfigError("a batch needs --batch and --out, and no text", remedy="see `swiftbot plan --help`")
        return await _batch(batch, out, tier, model, config, site, as_json=as_json)
    if not text:
        raise ConfigError("there is no instruction", remedy='such as: swiftbot plan "Robot_1: go to goal 2"')

    from appliance.client import roster_of
    from appliance.llm.stop_words import stop_request

    async with where.client() as client:
        await client.gateway()
        if (stop := stop_request(text, roster_of(client))) is not None:
            unknown = {"unknown": stop.unknown} if stop.unknown else {}
            show({"decision": "stop", "robots": stop.robots, **unknown}, as_json=as_json, table=_stop_text(stop))
            return Exit.DONE
        answer = await client.plan(text, private=private)
        if dry_run:
            found = await estimate_of(client, answer.plan)
            both = Group(console.plan_answer(answer), estimate_text(found))
            show(PlanEstimated(**fields(answer), estimate=found), as_json=as_json, table=both)
            return Exit.DONE
    show(answer, as_json=as_json, table=console.plan_answer(answer))
    return 0


def _stop_text(stop: "StopRequest") -> str:
    names = [*stop.robots, *(f"{each} (no such robot)" for each in stop.unknown)]
    who = ", ".join(names) or "all robots"
    return f"stop: {who} (soft stop; `swiftbot submit` or `swiftbot stop` carries it out)"


async def _batch(
    cases: Path, out: Path, tier: str, model: str, config: Path | None, site: str, *, as_json: bool
) -> int:
    from msgspec.structs import replace

    from appliance.config import load
    from appliance.llm.batch import Choice, run
    from appliance.llm.settings import LlmConfig
    from appliance.skills.sites import load_site

    read = load(config) if config is not None else None
    llm = read.llm if read is not None else LlmConfig()
    llm = replace(llm, local_model=model) if model else llm
    choice: Choice = tier  # type: ignore[assignment]

    def say(text: str) -> None:
        console.err.print(text, markup=False, highlight=False, soft_wrap=True)

    try:
        report = await run(
            cases, out, config=llm, catalogue=_catalogue(read), tier=choice,
            safety=read.safety if read is not None else None, site=load_site(site) if site else None, progress=say,
        )  # fmt: skip
    except asyncio.CancelledError:
        say(f"interrupted; what is in {out} stays, and the same command continues")
        return Exit.INTERRUPTED
    text = (
        f"{report.written} predictions written to {out}, {report.before} were there, "
        f"{report.planless} cases without a plan, {len(report.malformed)} lines left out"
    )
    show(report, as_json=as_json, table=text)
    return Exit.REFUSED if report.malformed else Exit.DONE


def _catalogue(config: "GatewayConfig | None") -> "Catalogue":
    from appliance.skills.catalogue import load_catalogue

    return load_catalogue(tuple(Path(folder).expanduser() for folder in config.skills) if config is not None else ())


async def skill_stats(
    *,
    limit: Annotated[int, Parameter(help="How many rows at most, the least reliable first.")] = 50,
    gateway: Annotated[str, Parameter(help="Which gateway's; by default any.")] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Show the success rates of skills on robots, and the planner thresholds that they moved."""
    async with where.client() as client:
        found = await client.experience(limit, gateway)
    show(found, as_json=as_json, table=console.experience_table(found))
    return 0
