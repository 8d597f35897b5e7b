"""Runs, rounds and clients as people read them: tables and sentences for the command line and the terminal UI."""

import time
from collections.abc import Iterable

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from appliance.learn import privacy
from appliance.learn.status import statuses
from appliance.model.learn_api import ClientWhy, LearnShown
from appliance.model.learning import Activity, ClientState, ClientStatus, Model, RunRecord


def seconds(value: float | None) -> str:
    """A time in seconds as it is read, `–` where it is not known."""
    if value is None:
        return "–"
    return f"{value * 1e3:.0f} ms" if value < 1 else f"{value:.1f} s" if value < 100 else f"{value / 60:.1f} min"


def number(value: float | None) -> str:
    """A loss or an accuracy."""
    return "–" if value is None else f"{value:.3f}"


def size(count: int) -> str:
    """A number of bytes, `–` for none."""
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB" if count else "–"


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column)
    return table


def runs(found: Iterable[RunRecord]) -> RenderableType:
    """All runs, a line each."""
    table = _table("run", "model", "mode", "state", "round", "clients", "accuracy", "loss", "started", "why")
    for run in found:
        last = run.history[-1] if run.history else None
        table.add_row(
            run.id, run.recipe.model, str(run.recipe.mode), str(run.state),
            f"{run.round}/{run.recipe.rounds.count}", str(sum(not each.excluded for each in run.clients)),
            number(_accuracy(run)), number(last.loss if last is not None else None),
            time.strftime("%m-%d %H:%M", time.localtime(run.started_ns / 1e9)), Text(run.why),
        )  # fmt: skip
    return table if table.rows else Text("no runs")


def _accuracy(run: RunRecord) -> float | None:
    """The last accuracy that was measured."""
    return next((line.accuracy for line in reversed(run.history) if line.accuracy is not None), None)


def shown(found: LearnShown) -> RenderableType:
    """One run: its state, the open round, the last rounds, the clients."""
    run, open_round = found.run, found.round
    parts: list[RenderableType] = [
        Text(f"{run.id}: {run.recipe.model}, {run.recipe.mode}, {run.state}{f' ({run.why})' if run.why else ''}"),
        Text(
            f"model {run.model.number} {run.model.digest[:12]} on {', '.join(run.model.gateways) or 'no gateway yet'}"
        ),
    ]
    if (dp := run.recipe.update.dp) is not None:
        spent = run.history[-1].epsilon if run.history else 0.0
        told = f"above {privacy.MOST:g}" if spent is None else number(spent)
        parts.append(Text(f"privacy: ε {told} at δ {dp.delta:g} so far (clip {dp.clip:g}, noise {dp.noise:g})"))
    if open_round is not None and not run.state.final:
        deadline = f", deadline {seconds(open_round.deadline_s)}" if open_round.deadline_s is not None else ""
        parts.append(
            Text(
                f"round {open_round.number} of {run.recipe.rounds.count} for {seconds(found.elapsed_s)}{deadline}, "
                f"coordinator {found.coordinator}, next {found.successor or 'none'}"
            )
        )
        if open_round.waits:
            parts.append(Text(f"waits for {open_round.waits}"))
    parts += [Text(""), _history(run), Text(""), _clients(found)]
    return Group(*parts)


def _history(run: RunRecord) -> RenderableType:
    table = _table("round", "took", "waiting for all", "clients", "samples", "sent", "loss", "accuracy", "closed")
    for line in run.history[-10:]:
        table.add_row(
            str(line.number), seconds(line.took_s), seconds(line.all_s), str(line.clients), f"{line.samples:,}",
            size(line.sent_bytes), number(line.loss), number(line.accuracy), Text(line.why),
        )  # fmt: skip
    return table if table.rows else Text("no round is closed yet")


def speed(status: ClientStatus) -> str:
    """How fast a client trains, as learned in the rounds before."""
    return "–" if status.samples_s is None else f"{status.samples_s:.0f}/s"


def state(status: ClientStatus) -> str:
    """What a client is at: with progress where it trains, with rounds where it is late."""
    late = f" {status.staleness}" if status.state is Activity.LATE else ""
    progress = f" {status.progress:.0%}" if status.state in (Activity.TRAINING, Activity.LATE) else ""
    return f"{status.state}{late}{progress}"


def _clients(found: LearnShown) -> RenderableType:
    table = _table(
        "client", "state", "gateway", "samples", "speed", "ETA", "stale", "parts", "rounds", "loss", "why"
    )  # fmt: skip
    for each in clients(found):
        table.add_row(
            each.client, state(each), each.gateway, f"{each.samples:,}" if each.samples else "–", speed(each),
            seconds(each.eta_s), str(each.staleness or ""), str(each.parts or ""), str(each.rounds),
            number(each.loss), Text(each.why),
        )  # fmt: skip
    for part in found.working:
        if part.part:
            table.add_row(f"  part of {part.client}", f"{part.progress:.0%}", part.gateway, *[""] * 7, part.helper)
    return table


def clients(found: LearnShown) -> tuple[ClientStatus, ...]:
    """What the clients of a run are at: as its coordinator says, or by the records."""
    return found.clients or statuses(found.run, found.round, found.working)


def explained(found: LearnShown, client: ClientState) -> ClientWhy:
    """Return what `why` tells, for programs."""
    return ClientWhy(
        client=client,
        status=next(each for each in clients(found) if each.client == client.name),
        working=tuple(each for each in found.working if client.name in (each.client, each.helper)),
        given_up=tuple(
            order
            for order in (found.round.orders if found.round is not None else ())
            if order.client == client.name and order.given_up
        ),
        deadline_s=found.round.deadline_s if found.round is not None else None,
    )


def why(found: LearnShown, client: ClientState) -> RenderableType:
    """Why a client is where it is: what it was given, what it waits for, what became of its updates."""
    status = next(each for each in clients(found) if each.client == client.name)
    lines = [f"{client.name}: {state(status)}{f' ({status.why})' if status.why else ''}"]
    lines.append(f"counted in {client.rounds} rounds, chosen last for round {client.chosen or 'none'}")
    if client.epoch_s is not None:
        lines.append(f"a whole epoch of {client.samples:,} samples takes it {seconds(client.epoch_s)}, {speed(status)}")
    if status.eta_s is not None:
        lines.append(f"its update is expected in {seconds(status.eta_s)}")
    if client.sent_bytes:
        lines.append(f"its last update that counted had {size(client.sent_bytes)}")
    if client.refused:
        lines.append(f"{client.refused} updates refused in a row: {client.note}")
    for each in found.working:
        if each.client == client.name:
            doer = f" by {each.helper}" if each.helper else ""
            where = f"at {each.gateway}" if each.gateway else "at no gateway yet"
            lines.append(
                f"order of round {each.round}, part {each.part}{doer}, attempt {each.attempt} {where} for "
                f"{seconds(each.since_s)}: {each.note or f'{each.progress:.0%}'}"
            )
    if found.round is not None:
        lines += [
            f"order of round {order.round}, part {order.part} was given up: {order.given_up}"
            for order in found.round.orders
            if order.client == client.name and order.given_up
        ]
        if found.round.deadline_s is not None:
            lines.append(f"the round's deadline is {seconds(found.round.deadline_s)} after it opened")
    return Text("\n".join(lines))


def models(found: Iterable[Model]) -> RenderableType:
    """The models that a run keeps."""
    table = _table("model", "digest", "gateways", "accuracy", "loss", "bytes", "kept")
    for model in found:
        size = sum(int(reference.get("bytes", 0)) for reference in model.shards)
        table.add_row(
            str(model.number), model.digest[:16], ", ".join(model.gateways), number(model.accuracy),
            number(model.loss), f"{size:,}", "marked" if model.marked else "",
        )  # fmt: skip
    return table if table.rows else Text("no models yet")
