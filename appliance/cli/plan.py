"""Plans and what is learned from them: `swiftbot plan`, `swiftbot experience`."""

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, show
from appliance.client import FleetClient
from appliance.errors import ConfigError, Exit

if TYPE_CHECKING:
    from appliance.llm.stop_words import StopRequest


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (plan, experience):
        app.command(command, group=WORK)


def plan(
    text: str = "",
    *,
    private: Annotated[
        bool, Parameter(negative="", help="Ask no other machine: neither another gateway's model nor one upstream.")
    ] = False,
    batch: Annotated[Path | None, Parameter(help="Plan a JSONL file of cases instead, without a fleet.")] = None,
    out: Annotated[Path | None, Parameter(help="Where their predictions go; gone on with when it is there.")] = None,
    tier: Annotated[
        Literal["auto", "local", "upstream", "rules"], Parameter(help="Of a batch: who plans; auto asks in order.")
    ] = "auto",
    model: Annotated[str, Parameter(help="Of a batch: folder of the local model.")] = "",
    config: Annotated[Path | None, Parameter(help="Of a batch: a gateway's file, for [llm] and [safety].")] = None,
    site: Annotated[
        str,
        Parameter(help="Of a batch: the site whose places, objects, fence and limits count; a name or TOML file."),
    ] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Decompose an instruction and print the plan with what it asks for; nothing is run.

    With --batch and --out each case `{"id", "instruction", "robots"?}` gets a line with plan, tier, confidence,
    latency, `decision` (run, hold, refuse, stop) and the checks that spoke. Ctrl-C keeps what is written, and the same
    command goes on. Lines that are no case are listed with their numbers and end the command with exit code 4.
    """
    if batch is not None or out is not None:
        if batch is None or out is None or text:
            raise ConfigError("a batch needs --batch and --out, and no text", remedy="see `swiftbot plan --help`")
        return _batch(batch, out, tier, model, config, site, as_json=as_json)
    if not text:
        raise ConfigError("there is no instruction", remedy='such as: swiftbot plan "Robot_1: go to goal 2"')

    from appliance.client import roster_of
    from appliance.llm.stop_words import stop_request

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            if (stop := stop_request(text, roster_of(client))) is not None:
                unknown = {"unknown": stop.unknown} if stop.unknown else {}
                show({"decision": "stop", "robots": stop.robots, **unknown}, as_json=as_json, table=_stop_text(stop))
                return
            answer = await client.plan(text, private=private)
        show(answer, as_json=as_json, table=console.plan_answer(answer))

    asyncio.run(go())
    return 0


def _stop_text(stop: "StopRequest") -> str:
    names = [*stop.robots, *(f"{each} (no such robot)" for each in stop.unknown)]
    who = ", ".join(names) or "all robots"
    return f"stop: {who} (soft stop; `swiftbot submit` or `swiftbot stop` carries it out)"


def _batch(cases: Path, out: Path, tier: str, model: str, config: Path | None, site: str, *, as_json: bool) -> int:
    from msgspec.structs import replace

    from appliance.config import load
    from appliance.llm.batch import Choice, Report, run
    from appliance.llm.settings import LlmConfig
    from appliance.skills.catalogue import load_catalogue
    from appliance.skills.sites import load_site

    read = load(config) if config is not None else None
    llm = read.llm if read is not None else LlmConfig()
    llm = replace(llm, local_model=model) if model else llm
    skills = tuple(Path(each).expanduser() for each in read.skills) if read is not None else ()
    choice: Choice = tier  # type: ignore[assignment]

    def told(text: str) -> None:
        console.err.print(text, markup=False, highlight=False, soft_wrap=True)

    async def go() -> Report:
        safety = read.safety if read is not None else None
        return await run(
            cases, out, config=llm, catalogue=load_catalogue(skills), tier=choice, safety=safety,
            site=load_site(site) if site else None, progress=told,
        )  # fmt: skip

    try:
        report = asyncio.run(go())
    except KeyboardInterrupt:
        told(f"interrupted; what is in {out} stays, and the same command goes on")
        return 130
    text = (
        f"{report.written} predictions written to {out}, {report.before} were there, "
        f"{report.planless} cases without a plan, {len(report.malformed)} lines left out"
    )
    show(report, as_json=as_json, table=text)
    return Exit.REFUSED if report.malformed else Exit.DONE


def experience(
    *,
    limit: Annotated[int, Parameter(help="Pairs of skill and robot, the least reliable first.")] = 50,
    gateway: Annotated[str, Parameter(help="Whose experience; by default any gateway's.")] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Show how skills have done on robots lately, and which thresholds of the planner that has moved."""
    from appliance.console import experience_table

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.experience(limit, gateway)
        show(found, as_json=as_json, table=experience_table(found))

    asyncio.run(go())
    return 0
