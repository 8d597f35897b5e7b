"""What the clients of a run are at, and a closed round in numbers: for those who watch, and for logs.

Plain functions of the records and of what a round's coordinator knows beside them.
"""

from collections.abc import Collection, Iterable, Mapping

from appliance.model.learn_api import Working
from appliance.model.learning import Activity, ClientState, ClientStatus, Order, RoundRecord, RunMetric, RunRecord

LEAST_PROGRESS = 0.05
"""Below it what is left is estimated by the rounds before."""


def statuses(
    run: RunRecord,
    record: RoundRecord | None,
    working: Iterable[Working],
    *,
    accepted: Collection[str] = (),
    places: Mapping[str, str] | None = None,
) -> tuple[ClientStatus, ...]:
    """Return what each client is at, in the order of the run's record.

    Args:
        run: the run's record.
        record: that of its open round; None: not known.
        working: the orders that are under way.
        accepted: clients whose updates are accepted in the open round.
        places: client -> gateway of those that are there; None: not known.
    """
    own: dict[str, Working] = {}
    helping: dict[str, Working] = {}
    parts: dict[str, int] = {}
    for each in working:
        if each.part:
            parts[each.client] = parts.get(each.client, 0) + 1
            helping[each.helper] = each
        else:
            own[each.client] = each
    orders = {order.client: order for order in (record.orders if record is not None else ()) if not order.part}

    def told(client: ClientState) -> ClientStatus:
        name = client.name
        at_work = own.get(name) or helping.get(name)
        state, why = _state(run, client, own.get(name), helping.get(name), orders.get(name), accepted, places)
        under_way = state in (Activity.WAITING, Activity.TRAINING, Activity.LATE)
        order = orders.get(name) if name in own else None
        return ClientStatus(
            run=run.id,
            client=name,
            round=run.round,
            state=state,
            gateway=at_work.gateway if at_work is not None and under_way else (places or {}).get(name, ""),
            attempt=at_work.attempt if at_work is not None and under_way else 0,
            progress=round(at_work.progress, 2) if at_work is not None and under_way else 0.0,
            samples=client.samples,
            samples_s=round(client.samples / client.epoch_s, 2) if client.epoch_s and client.samples else None,
            epoch_s=client.epoch_s,
            eta_s=_eta_s(at_work, order, client.epoch_s) if at_work is not None and under_way else None,
            staleness=max(0, run.round - at_work.round) if at_work is not None and under_way else 0,
            parts=parts.get(name, 0),
            rounds=client.rounds,
            loss=client.loss,
            why=why,
        )

    return tuple(map(told, run.clients))


def _state(
    run: RunRecord,
    client: ClientState,
    own: Working | None,
    helping: Working | None,
    order: Order | None,
    accepted: Collection[str],
    places: Mapping[str, str] | None,
) -> tuple[Activity, str]:
    """What a client is at, and why."""
    if client.excluded:
        return Activity.EXCLUDED, client.excluded
    if run.state.final:
        return Activity.ENDED, client.note
    if own is not None or helping is not None:
        return _at_work(run, client, own, helping, order)
    if client.name in accepted:
        return Activity.DONE, client.note
    if places is not None and client.name not in places:
        return Activity.ABSENT, f"{client.name} is not there"
    if order is not None and order.given_up:
        return Activity.LEFT_OUT, order.given_up
    return Activity.IDLE, client.note


def _at_work(
    run: RunRecord, client: ClientState, own: Working | None, helping: Working | None, order: Order | None
) -> tuple[Activity, str]:
    """What a client that has an order of its own, or helps another, is at, and why."""
    if own is not None:
        why = own.note or client.note
        if own.round and own.round < run.round:
            return Activity.LATE, why
        return _begun(own), why
    assert helping is not None  # noqa: S101 - the caller has one of both
    why = f"helps {helping.client}" + (f": {helping.note}" if helping.note else "")
    if order is not None and order.given_up:
        why += f"; left out: {order.given_up}"
    return _begun(helping), why


def _begun(at_work: Working) -> Activity:
    return Activity.TRAINING if at_work.gateway and not at_work.queued else Activity.WAITING


def _eta_s(at_work: Working, order: Order | None, epoch_s: float | None) -> float | None:
    """Seconds until an order under way has its update; None where nothing is known."""
    left: float | None = None
    if at_work.progress >= LEAST_PROGRESS:
        left = at_work.since_s * (1.0 - at_work.progress) / at_work.progress
    elif epoch_s is not None and order is not None:
        left = epoch_s * (order.share[1] - order.share[0]) - at_work.since_s
    if left is not None and order is not None and order.stop_at_s is not None:
        left = min(left, order.stop_at_s - at_work.since_s)
    return None if left is None else round(max(0.0, left), 1)


def metric(run: RunRecord, number: int) -> RunMetric | None:
    """Return a closed round in numbers; None where the run's history does not have it."""
    line = next((line for line in reversed(run.history) if line.number == number), None)
    if line is None:
        return None
    model = next((model for model in (run.model, *run.models) if model.number == number), None)
    return RunMetric(
        run=run.id,
        round=number,
        took_s=line.took_s,
        all_s=line.all_s,
        clients=line.clients,
        samples=line.samples,
        loss=line.loss,
        accuracy=line.accuracy,
        test_loss=model.loss if model is not None else None,
        epsilon=line.epsilon,
    )
