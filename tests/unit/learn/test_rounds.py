"""The decider of a round: what holds whatever happens, and what each mode does."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.learn import privacy, rounds
from appliance.learn.rounds import Decider
from appliance.model.learning import (
    Clients,
    ClientState,
    Cohort,
    Data,
    Dp,
    Mode,
    Model,
    Order,
    PartialUpdate,
    PublicKeys,
    Recipe,
    RoundRecord,
    Rounds,
    RunRecord,
    RunState,
    Update,
    UpdateRecord,
)
from workshop.simulators.learning import Device, Faults, Simulation

some = st.floats(0.0, 0.3)


@st.composite
def faults(draw: st.DrawFn) -> Faults:
    """Anything may go wrong, and nothing always."""
    return Faults(
        fails=draw(some), silent=draw(st.floats(0, 0.1)), leaves=draw(some), repeated=draw(some), foreign=draw(some),
        takeover=draw(st.floats(0, 0.2)), refused=draw(st.floats(0, 0.1)), aggregation=draw(some),
        lost=draw(some), transient=draw(some),
    )  # fmt: skip


def recipe(mode: Mode = Mode.PARTIAL, *, clients: int = 8, count: int = 6, **changes: Any) -> Recipe:
    """A recipe of so many partitions, with other settings of its rounds."""
    share = "fleet" if mode is Mode.OFFLOAD else "never"
    settings_: dict[str, Any] = {"count": count, "mode": mode, "timeout_s": 50.0, **changes}
    return Recipe(
        model="clips", data=Data(share=share), clients=Clients(partitions=clients), rounds=Rounds(**settings_)
    )


def devices(clients: int, slow: int = 0) -> dict[str, Device]:
    """So many devices of which the first are five times slower."""
    return {f"part-{n:03d}": Device(5.0 if n < slow else 1.0 + n / 100, 96) for n in range(clients)}


@given(
    st.sampled_from([Mode.SYNC, Mode.BUFFERED, Mode.PARTIAL, Mode.OFFLOAD]), faults(), st.integers(0, 2**20),
    st.integers(2, 9), st.integers(0, 4), st.integers(0, 3), st.sampled_from([1.0, 1.3]),
)  # fmt: skip
@example(  # an order that is due while a failed aggregation is put off
    mode=Mode.PARTIAL,
    wrong=Faults(
        fails=0.0625, transient=0.125, silent=0.015625, leaves=0.0625, repeated=0.25, foreign=0.25,
        refused=1.192092896e-07, lost=0.25, aggregation=0.25,
    ),
    seeded=0, clients=6, slow=0, per_round=0, over=1.0,
)  # fmt: skip
@settings(deadline=None, max_examples=150)
def test_whatever_happens_each_round_makes_one_model_of_each_update_once(
    mode: Mode, wrong: Faults, seeded: int, clients: int, slow: int, per_round: int, over: float
) -> None:
    """With failing, silent, leaving and foreign clients and takeovers the simulator's invariants hold to the end."""
    chosen = Clients(partitions=clients, per_round=min(per_round, clients), over_selection=over)
    made = replace(recipe(mode, clients=clients), clients=chosen)
    # Excluded clients do not come back: with few clients a run may be left with none.
    wrong = replace(wrong, refused=0.0) if clients < 6 else wrong
    outcome = Simulation(made, devices(clients, slow), faults=wrong, seed_number=seeded).play(most_events=20_000)
    assert outcome.run.state is RunState.SUCCEEDED
    assert [line.number for line in outcome.run.history] == list(range(1, 7))
    assert all(line.clients or line.why for line in outcome.run.history)


def test_sync_waits_for_the_slowest() -> None:
    """Each round takes what the slowest client takes, and all clients count in each."""
    outcome = Simulation(recipe(Mode.SYNC), devices(8, slow=2)).play()
    assert outcome.took_s == (5.0,) * 6
    assert set(outcome.counted.values()) == {6}
    assert outcome.late == 0


def test_buffered_closes_early_and_counts_the_late() -> None:
    """Rounds close at three quarters; the slow ones' updates count later."""
    outcome = Simulation(recipe(Mode.BUFFERED, count=12), devices(8, slow=2)).play()
    assert max(outcome.took_s) < 2.5
    assert outcome.late > 0
    assert outcome.counted["part-000"] > 0


def test_partial_work_ends_at_the_deadline() -> None:
    """Once speeds are known a round takes 1.3 medians, and the slow clients count in each round."""
    outcome = Simulation(recipe(Mode.PARTIAL, count=12), devices(8, slow=2)).play()
    assert max(outcome.took_s[6:]) < 1.5
    assert outcome.counted["part-000"] >= 6
    assert outcome.all_s[-1] == pytest.approx(5.0, rel=0.2)


def test_offload_gives_the_rest_of_slow_clients_to_idle_ones() -> None:
    """Parts are trained by others and the round takes less than half of what waiting for all would."""
    outcome = Simulation(recipe(Mode.OFFLOAD, count=12), devices(16, slow=2)).play()
    assert outcome.offloaded > 0
    assert max(outcome.took_s[6:]) < 2.5
    assert outcome.counted["part-000"] >= 6


def test_without_slow_clients_no_mode_costs_anything() -> None:
    """All alike: every mode takes one epoch, within the devices' one per cent steps."""
    for mode in (Mode.SYNC, Mode.PARTIAL, Mode.OFFLOAD):
        outcome = Simulation(recipe(mode), devices(8)).play()
        assert max(outcome.took_s) <= 1.08, mode


def test_a_client_left_out_is_preferred() -> None:
    """With 4 of 20 a round, everybody has been chosen after so many rounds as fairness needs."""
    made = replace(recipe(Mode.SYNC, clients=20, count=20), clients=Clients(partitions=20, per_round=4))
    outcome = Simulation(made, devices(20)).play()
    assert min(outcome.counted[name] for name in devices(20)) >= 2
    assert max(outcome.counted.values()) <= 7


def test_a_quarter_that_comes_late_takes_part_in_the_running_or_the_next_round() -> None:
    """Clients that are not there at first are in each round from the one after they came on."""
    late = {"part-006": 2.2, "part-007": 2.2}
    outcome = Simulation(recipe(Mode.SYNC), devices(8), late_devices=late).play()
    assert outcome.counted["part-006"] == 3


def started(made: Recipe, *, present: int = 8) -> tuple[Decider, RunRecord, list[rounds.Instruction]]:
    """A decider at the beginning of round 1, and what it wants."""
    clients = tuple(ClientState(name=name) for name in made.names)
    run = RunRecord(id="r", recipe=made, clients=clients)
    there = dict.fromkeys(made.names[:present], "gw")
    decider = Decider(run, RoundRecord(run="r", number=1), present=there, now=100.0)
    return decider, run, decider.resume(100.0)


def update(client: str, **changes: object) -> PartialUpdate:
    """A whole update of round 1."""
    return replace(PartialUpdate(client=client, round=1, samples=96, steps=6, steps_whole=6, took_s=1.0), **changes)


def arrived(decider: Decider, sent: PartialUpdate, *, run: str = "r", now: float = 101.0) -> list[rounds.Instruction]:
    """Have an update come."""
    return decider.handle(rounds.Arrived(run, sent), now)


def test_orders_are_written_before_they_are_sent() -> None:
    """The cohort stands in the record before a client hears of it: a successor knows whom to ask."""
    _, _, wanted = started(recipe())
    assert isinstance(wanted[0], rounds.WriteRound)
    written = wanted[0].record.orders
    assert [each.order for each in wanted[1:] if isinstance(each, rounds.Send)] == list(written)
    assert len(written) == 8


@pytest.mark.parametrize(
    "changes",
    [{"samples": 0}, {"samples": -1}, {"samples": 10**12}, {"steps": 0}, {"steps": 7}, {"loss": float("nan")}],
)
def test_an_update_that_cannot_be_is_refused_with_its_reason(changes: dict[str, object]) -> None:
    """It does not count, the client's note says why, and the round goes on with the others."""
    made = recipe(Mode.SYNC, clients=2)
    decider, run, _ = started(made, present=2)
    assert any(isinstance(each, rounds.Refuse) for each in arrived(decider, update("part-000", **changes)))
    wanted = arrived(decider, update("part-001"))
    aggregate = next(each for each in wanted if isinstance(each, rounds.Aggregate))
    assert [share.update.client for share in aggregate.shares] == ["part-001"]
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {}), 102.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=1)
    assert after is not None
    assert after.clients[0].refused == 1
    assert after.clients[0].note


@pytest.mark.parametrize("sent", [update("part-000", round=0), update("part-000", round=2), update("stranger")])
def test_what_nobody_ordered_does_not_count(sent: PartialUpdate) -> None:
    """Another round's, or of a client that is not in the cohort: nothing is accepted."""
    decider, _, _ = started(recipe())
    assert not any(isinstance(each, rounds.Accept) for each in arrived(decider, sent))


def test_another_runs_or_an_older_attempts_update_is_refused() -> None:
    """The same client and round, and yet not what was ordered."""
    decider, _, _ = started(recipe())
    assert isinstance(arrived(decider, update("part-000"), run="other")[0], rounds.Refuse)
    again = decider.handle(rounds.Failed(("part-000", 1, 0), 1, "out of memory"), 101.0)
    assert [each.order.attempt for each in again if isinstance(each, rounds.Send)] == [2]
    assert isinstance(arrived(decider, update("part-000"))[0], rounds.Refuse)
    assert isinstance(arrived(decider, update("part-000", attempt=2))[0], rounds.Accept)
    assert arrived(decider, update("part-000", attempt=2)) == []


def test_two_refused_updates_in_a_row_exclude_a_client() -> None:
    """The second refusal names the reason; one that counts between them begins again."""
    client = ClientState(name="a")
    run = RunRecord(id="r", recipe=recipe(clients=1), clients=(client,))
    record = RoundRecord(run="r", number=1, closed=True)
    for refusal, expected in (("nan", ""), ("", ""), ("nan", ""), ("norm", "2 updates refused in a row")):
        patch = rounds.Patch(chosen=True, counted=not refusal, refused=refusal, refusals=int(bool(refusal)))
        after = rounds.closed(
            run, rounds.Result(replace(record, number=run.round), Model(), {"a": patch}, 1.0, 1.0), now_ns=0
        )
        assert after is not None
        run = after
        assert run.clients[0].excluded.startswith(expected)
        assert bool(run.clients[0].excluded) == bool(expected)


def test_a_paused_run_orders_nothing_and_closes_nothing_and_goes_on_afterwards() -> None:
    """Updates that come meanwhile are kept; resumed, the round closes with them."""
    decider, run, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    decider.handle(rounds.Changed(replace(run, state=RunState.PAUSED)), 100.5)
    for name in ("part-000", "part-001"):
        assert [type(each) for each in arrived(decider, update(name))] == [rounds.Accept]
    wanted = decider.handle(rounds.Changed(run), 110.0)
    assert any(isinstance(each, rounds.Aggregate) for each in wanted)


def test_a_stopped_run_ends_its_orders() -> None:
    """All that is under way is cancelled, and nothing follows."""
    decider, run, _ = started(recipe())
    wanted = decider.handle(rounds.Changed(replace(run, state=RunState.STOPPED)), 101.0)
    assert [type(each) for each in wanted] == [rounds.Cancel] * 8
    assert decider.done
    assert arrived(decider, update("part-000")) == []


def test_an_excluded_client_is_not_waited_for_and_does_not_count() -> None:
    """Excluded after its update came, and before the round closed: the update is left out."""
    decider, run, _ = started(recipe(Mode.SYNC, clients=3), present=3)
    arrived(decider, update("part-000"))
    clients = tuple(replace(each, excluded="by anna") if each.name != "part-002" else each for each in run.clients)
    decider.handle(rounds.Changed(replace(run, clients=clients)), 102.0)
    wanted = arrived(decider, update("part-002"), now=103.0)
    aggregate = next(each for each in wanted if isinstance(each, rounds.Aggregate))
    assert [share.update.client for share in aggregate.shares] == ["part-002"]


def test_a_round_says_what_it_waits_for() -> None:
    """Nobody is there; slow ones; those that do not answer: each in words."""
    decider, _, _ = started(recipe(), present=0)
    assert decider.waits == "no client is there"
    decider, _, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    arrived(decider, update("part-001"))
    assert decider.waits == "1 of 2 clients: part-000"
    decider.handle(rounds.Lost("part-000"), 102.0)
    assert decider.waits == "aggregation"


def test_a_client_that_is_back_goes_on_with_its_order() -> None:
    """With the next attempt, so that what its first one still sends does not count beside it."""
    decider, _, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    decider.handle(rounds.Lost("part-000"), 100.5)
    back = decider.handle(rounds.Present("part-000", "gw"), 101.0)
    assert [each.order.attempt for each in back if isinstance(each, rounds.Send)] == [2]


def test_late_updates_weigh_less_and_count_once() -> None:
    """An order that is carried on counts in the next round at 1/sqrt(2), and is gone then."""
    decider, run, _ = started(recipe(Mode.BUFFERED, clients=4), present=4)
    for name in ("part-000", "part-001", "part-002"):
        wanted = arrived(decider, update(name))
    assert isinstance(wanted[-1], rounds.Aggregate)
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {}), 102.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=0)
    assert after is not None
    following = Decider(after, rounds.opened(close.result), present=dict.fromkeys(run.recipe.names, "gw"), now=102.0)
    sent = [each.order.client for each in following.resume(102.0) if isinstance(each, rounds.Send)]
    assert sent.count("part-003") == 1  # it was never told to a gateway: sent again with its own round's base
    assert isinstance(arrived(following, update("part-003"))[0], rounds.Accept)
    for name in ("part-000", "part-001"):
        wanted = arrived(following, update(name, round=2), now=103.0)
    wanted = wanted if isinstance(wanted[-1], rounds.Aggregate) else arrived(following, update("part-002", round=2))
    aggregate = wanted[-1]
    assert isinstance(aggregate, rounds.Aggregate)
    weights = {share.update.client: share.weight for share in aggregate.shares}
    assert weights["part-003"] == int(96 * 1024 / 2**0.5)
    assert weights["part-000"] == 96 * 1024


def test_partial_work_is_normalised_to_a_whole_epoch() -> None:
    """A third of the steps counts thrice, with the weight of all samples; less than a tenth is not blown up further."""
    decider, _, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    arrived(decider, update("part-000", steps=2))
    wanted = arrived(decider, update("part-001", steps=1, steps_whole=100))
    aggregate = wanted[-1]
    assert isinstance(aggregate, rounds.Aggregate)
    assert [(share.weight, share.scale) for share in aggregate.shares] == [(96 * 1024, (6, 2)), (96 * 1024, (10, 1))]


def test_what_a_client_waits_for_does_not_make_it_slow() -> None:
    """Three seconds for a container and half a second for a tenth of the steps: five seconds more, not thirty."""
    decider, run, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    arrived(decider, update("part-000", steps=1, steps_whole=10, took_s=3.5, train_s=0.5))
    arrived(decider, update("part-001", steps=10, steps_whole=10, took_s=1.0, train_s=99.0))
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {}), 102.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=0)
    assert after is not None
    assert [client.epoch_s for client in after.clients] == [8.0, 1.0]


def offloading(samples: int) -> tuple[Decider, RunRecord, list[rounds.Instruction]]:
    """A round of four clients of which the first is slow and has so many samples, and what is wanted at first."""
    made = recipe(Mode.OFFLOAD, clients=4)
    clients = tuple(
        ClientState(name=name, epoch_s=1.0 if number else 5.0, samples=96 if number else samples)
        for number, name in enumerate(made.names)
    )
    run = RunRecord(id="r", recipe=made, clients=clients)
    decider = Decider(
        run, RoundRecord(run="r", number=1), present=dict.fromkeys(made.names, "gw"), now=100.0
    )  # fmt: skip
    return decider, run, decider.resume(100.0)


def test_of_a_share_of_its_samples_nothing_is_learned_about_how_many_a_client_has() -> None:
    """The parts that helpers did not send are still its own: the next round must not leave them out."""
    decider, run, wanted = offloading(96)
    order = next(
        each.order for each in wanted if isinstance(each, rounds.Send) and each.order.client == "part-000"
    )  # fmt: skip
    assert order.share[1] < 0.5
    for name in run.recipe.names:
        wanted = arrived(decider, update(name, **({"samples": 25} if name == "part-000" else {})))
    wanted = decider.advance(200.0)
    assert isinstance(wanted[-1], rounds.Aggregate)
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {}), 201.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=0)
    assert after is not None
    assert [client.samples for client in after.clients] == [96] * 4


@pytest.mark.parametrize("samples", [1, rounds.MOST_LISTED + 1, rounds.MOST_SAMPLES])
def test_samples_too_few_to_share_or_too_many_to_list_are_not_offloaded(samples: int) -> None:
    """A share is an order that lists positions: of a billion samples the list would fill the coordinator's memory."""
    _, _, wanted = offloading(samples)
    assert all(each.order.share == (0.0, 1.0) for each in wanted if isinstance(each, rounds.Send))


def test_at_the_target_a_run_has_succeeded() -> None:
    """The evaluation's figures stand in the model, the history and the run."""
    run = RunRecord(id="r", recipe=recipe(target=0.9), model=Model(number=3), models=(Model(number=3),), round=4)
    below = rounds.evaluated(run, 3, accuracy=0.89, loss=0.4, now_ns=1)
    assert (below.state, below.model.accuracy) == (RunState.RUNNING, 0.89)
    reached = rounds.evaluated(run, 3, accuracy=0.9, loss=0.4, now_ns=1)
    assert reached.state is RunState.SUCCEEDED
    assert "target 0.9" in reached.why


def test_models_are_kept_by_age_and_mark() -> None:
    """The newest, and those that are marked."""
    models = tuple(Model(number=number, marked=number == 2) for number in range(1, 8))
    assert [model.number for model in rounds.kept_models(models, 3)] == [2, 5, 6, 7]


@pytest.mark.long
@pytest.mark.timeout(900)
def test_ten_thousand_clients_many_rounds() -> None:
    """100 of 10,000 are chosen a round, some of everything goes wrong: the invariants hold, and nobody is left out."""
    slow = {
        f"part-{n:05d}": Device(5.0 if n % 8 == 0 else 3.0 if n % 8 == 1 else 1.0 + n % 100 / 500)
        for n in range(10_000)
    }
    made = Recipe(
        model="clips",
        clients=Clients(partitions=1000, per_round=100),
        rounds=Rounds(count=1000, mode=Mode.PARTIAL, timeout_s=50.0),
    )
    wrong = Faults(
        fails=0.02, silent=0.002, leaves=0.02, repeated=0.02, foreign=0.01, takeover=0.0005, refused=0.001,
        aggregation=0.01,
    )  # fmt: skip
    outcome = Simulation(made, slow, faults=wrong, seed_number=1).play()
    assert outcome.run.round == 1000
    assert outcome.takeovers > 50
    assert len(outcome.counted) == 10_000


def sent(wanted: list[rounds.Instruction]) -> list[tuple[str, int]]:
    """Clients and attempts that are to begin."""
    return [(each.order.client, each.order.attempt) for each in wanted if isinstance(each, rounds.Send)]


def test_what_passes_by_itself_uses_up_no_attempt() -> None:
    """Ten minutes without a free container: the order is made again with growing pauses, and the round says why."""
    decider, _, _ = started(recipe(Mode.SYNC, clients=2, timeout_s=3600.0), present=2)
    arrived(decider, update("part-001"))
    now, attempts = 101.0, 1
    while now < 700.0:
        failed = rounds.Failed(("part-000", 1, 0), attempts, "gw-1: its pool is full", transient=True)
        assert sent(decider.handle(failed, now)) == []
        assert decider.waits == "1 of 2 clients: part-000 (gw-1: its pool is full)"
        at = decider.next_at(now)
        assert at is not None
        assert now < at <= now + 30.1
        now, attempts = at, attempts + 1
        assert sent(decider.advance(now)) == [("part-000", attempts)]
    assert attempts > 20
    closed = arrived(decider, update("part-000", attempt=attempts), now=now)
    assert any(isinstance(each, rounds.Aggregate) and len(each.shares) == 2 for each in closed)


def test_what_passes_by_itself_ends_with_the_time_that_a_client_is_waited_for() -> None:
    """A gateway that never has room: after `timeout_s` the client is given up, and the round closes without it."""
    decider, _, _ = started(recipe(Mode.SYNC, clients=2, timeout_s=50.0), present=2)
    arrived(decider, update("part-001"))
    decider.handle(rounds.Failed(("part-000", 1, 0), 1, "no room", transient=True), 149.0)
    closed = decider.advance(150.0)
    assert any(isinstance(each, rounds.Aggregate) and len(each.shares) == 1 for each in closed)
    assert "no answer within 50 s" in decider.record(150.0).orders[0].given_up


def test_an_order_that_cannot_begin_says_why() -> None:
    """No room at its gateway: the round's record names the client and the reason until a gateway takes it."""
    decider, _, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    decider.handle(rounds.Waiting(("part-001", 1, 0), 1, "gw-2: image learn is not built there"), 101.0)
    assert decider.record(101.0).waits == "2 of 2 clients: part-001 (gw-2: image learn is not built there), part-000"
    decider.handle(rounds.Ordered(("part-001", 1, 0), 1, "gw-2"), 102.0)
    assert decider.waits == "2 of 2 clients: part-000, part-001"


def test_a_failure_while_paused_is_tried_again_when_the_run_goes_on() -> None:
    """Paused, no attempt begins."""
    decider, run, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    decider.handle(rounds.Changed(replace(run, state=RunState.PAUSED)), 101.0)
    assert sent(decider.handle(rounds.Failed(("part-000", 1, 0), 1, "out of memory"), 102.0)) == []
    assert sent(decider.handle(rounds.Changed(run), 103.0)) == [("part-000", 2)]


def test_lost_updates_exclude_nobody() -> None:
    """An update whose files are gone does not count, the round closes without it, and its client is in the next one."""
    decider, run, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    arrived(decider, update("part-000"))
    arrived(decider, update("part-001"))
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {}, {"part-000": "lost: on no gateway"}), 102.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=1)
    assert after is not None
    assert [(each.refused, each.rounds, each.note) for each in after.clients] == [
        (0, 0, "lost: on no gateway"),
        (0, 1, ""),
    ]
    assert [each.refused for each in close.result.record.counted] == ["lost: on no gateway", ""]


def test_where_all_updates_are_lost_they_are_trained_again() -> None:
    """Nothing is left for a model: clients not chosen yet are taken, else those that were lost make another attempt."""
    made = replace(recipe(Mode.SYNC), clients=Clients(partitions=2, per_round=1))
    decider, _, wanted = started(made, present=2)
    ((first, _),) = sent(wanted)
    arrived(decider, update(first))
    wanted = decider.handle(rounds.TooFew(1, {}, {first: "lost: on no gateway"}), 102.0)
    assert [each.record.parts for each in wanted if isinstance(each, rounds.Accept)] == [()]
    ((second, _),) = sent(wanted)
    assert second != first
    wanted = arrived(decider, update(second), now=103.0)
    assert [share.update.client for each in wanted if isinstance(each, rounds.Aggregate) for share in each.shares] == [
        second
    ]
    assert decider.handle(rounds.TooFew(1, {}, {second: "lost: on no gateway"}), 104.0)
    assert "1 more clients: " in decider.waits
    assert "lost: on no gateway" in decider.waits
    at = decider.next_at(104.0)
    assert at is not None
    assert sorted(sent(decider.advance(at))) == sorted([(first, 2), (second, 2)])


def test_what_is_due_while_an_aggregation_is_put_off_wakes_nobody() -> None:
    """A late client's order and its time limit are due in the pause: the decider is woken once, at the pause's end."""
    decider, _, _ = started(recipe(Mode.BUFFERED, clients=4, timeout_s=11.0), present=4)
    assert sent(decider.handle(rounds.Failed(("part-003", 1, 0), 1, "no room", transient=True), 109.5)) == []
    for name in ("part-000", "part-001", "part-002"):
        wanted = arrived(decider, update(name), now=109.6)
    assert isinstance(wanted[-1], rounds.Aggregate)
    decider.handle(rounds.AggregateFailed("the disk is full"), 110.2)
    assert decider.next_at(110.2) == 111.2
    assert decider.advance(110.6) == []
    assert decider.next_at(110.6) == 111.2
    assert isinstance(decider.advance(111.2)[-1], rounds.Aggregate)


def refused_twice(
    refuse: Callable[[Decider, int, float], list[rounds.Instruction]], made: Recipe
) -> tuple[Decider, RunRecord, list[rounds.Instruction]]:
    """Two clients of which the first's updates are refused each time, by an attempt and the time; the second is gone.

    Before the second refusal another coordinator goes on from the record.
    """
    decider, run, _ = started(made, present=2)
    decider.handle(rounds.Lost("part-001"), 100.5)
    refuse(decider, 1, 101.0)
    at = decider.next_at(101.0)
    assert at is not None
    again = decider.advance(at)
    assert sent(again) == [("part-000", 2)]
    assert isinstance(again[0], rounds.WriteRound)
    decider = Decider(run, again[0].record, present={"part-000": "gw"}, now=at)
    decider.resume(at)
    return decider, run, refuse(decider, 2, at + 1.0)


def refused_by_what_it_says(decider: Decider, attempt: int, now: float) -> list[rounds.Instruction]:
    """Have an update come with a loss that is not finite."""
    return arrived(decider, update("part-000", attempt=attempt, loss=float("nan")), now=now)


def refused_where_it_is_summed(decider: Decider, attempt: int, now: float) -> list[rounds.Instruction]:
    """Have an update come, and be refused by the aggregation."""
    assert isinstance(arrived(decider, update("part-000", attempt=attempt), now=now)[-1], rounds.Aggregate)
    return decider.handle(rounds.TooFew(1, {"part-000": "nan: NaN or infinite values"}), now)


@pytest.mark.parametrize(
    ("refuse", "reason"),
    [(refused_by_what_it_says, "its loss is not finite"), (refused_where_it_is_summed, "nan: NaN or infinite values")],
)
def test_a_client_that_is_refused_each_time_is_excluded_within_the_round(
    refuse: Callable[[Decider, int, float], list[rounds.Instruction]], reason: str
) -> None:
    """Two in a row, also across a takeover: the run's record has it, the round says why it waits and orders no more."""
    decider, run, wanted = refused_twice(refuse, recipe(Mode.SYNC, clients=2))
    (exclude,) = (each for each in wanted if isinstance(each, rounds.Exclude))
    assert exclude == rounds.Exclude(1, "part-000", f"2 updates refused in a row, the last: {reason}")
    after = rounds.excluded(run, exclude, now_ns=1)
    assert after is not None
    assert [each.excluded for each in after.clients] == [exclude.reason, ""]
    assert rounds.excluded(after, exclude, now_ns=2) is None
    assert decider.waits == f"1 more clients: part-000: {exclude.reason}, and no other is there"
    now = 110.0
    while (at := decider.next_at(now)) is not None and now < 1000.0:
        now = at
        assert decider.advance(now) == []
    decider.handle(rounds.Lost("part-000"), now)
    assert decider.handle(rounds.Present("part-000", "gw"), now) == []
    # Another one is there: the round is made with it, and the run's record is as where the close excludes a client.
    wanted = decider.handle(rounds.Present("part-001", "gw"), now + 1.0)
    ((other, attempt),) = sent(wanted)
    assert other == "part-001"
    arrived(decider, update(other, attempt=attempt), now=now + 2.0)
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {}), now + 3.0)
    assert isinstance(close, rounds.Close)
    closed = rounds.closed(after, close.result, now_ns=3)
    assert closed is not None
    assert [(each.excluded, each.refused) for each in closed.clients] == [(exclude.reason, 2), ("", 0)]


def test_a_client_that_is_included_again_begins_anew() -> None:
    """Its order is made again, and one more refused update does not exclude it."""
    decider, run, wanted = refused_twice(refused_by_what_it_says, recipe(Mode.SYNC, clients=2))
    assert any(isinstance(each, rounds.Exclude) for each in wanted)
    wanted = decider.handle(rounds.Changed(run), 200.0)
    assert isinstance(wanted[0], rounds.WriteRound)
    assert [order.refused for order in wanted[0].record.orders] == [0, 0]
    assert sent(wanted) == [("part-000", 3)]
    wanted = refused_by_what_it_says(decider, 3, 201.0)
    assert [type(each) for each in wanted] == [rounds.Refuse]


def test_an_update_that_counts_after_a_refused_one_ends_the_row() -> None:
    """Refused, ordered again and counted: the client's record has no refusal."""
    decider, run, _ = started(recipe(Mode.SYNC, clients=1), present=1)
    refused_by_what_it_says(decider, 1, 101.0)
    at = decider.next_at(101.0)
    assert at is not None
    assert sent(decider.advance(at)) == [("part-000", 2)]
    arrived(decider, update("part-000", attempt=2), now=at + 1.0)
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {}), at + 2.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=1)
    assert after is not None
    assert (after.clients[0].refused, after.clients[0].excluded) == (0, "")


def test_a_rule_that_needs_more_updates_is_given_them() -> None:
    """One of five is unfit and multi-Krum needs five: a sixth client is ordered, and the round waits for it."""
    made = replace(recipe(Mode.SYNC), clients=Clients(partitions=6, per_round=5))
    decider, _, wanted = started(made, present=6)
    cohort = [client for client, _ in sent(wanted)]
    for client in cohort:
        arrived(decider, update(client))
    wanted = decider.handle(rounds.TooFew(5, {cohort[0]: "nan: NaN or infinite values"}), 102.0)
    ((sixth, _),) = sent(wanted)
    assert sixth not in cohort
    wanted = arrived(decider, update(sixth), now=103.0)
    assert any(isinstance(each, rounds.Aggregate) and len(each.shares) == 5 for each in wanted)


@pytest.mark.parametrize(
    ("mode", "round_s", "counted"), [(Mode.PARTIAL, 1.3, 16), (Mode.BUFFERED, 1.0, 12), (Mode.SYNC, 5.0, 16)]
)
def test_late_updates_stand_for_nobody_of_the_cohort(mode: Mode, round_s: float, counted: int) -> None:
    """Four of 16 clients are slow, so that updates are late at first: rounds settle, and do not close too early.

    With `partial` each round then waits for the deadline and counts all; with `buffered` so many fill it in each round.
    """
    devices = {f"part-{number:03d}": Device(epoch_s=5.0 if number < 4 else 1.0) for number in range(16)}
    recipe = Recipe(model="clips", clients=Clients(partitions=16), rounds=Rounds(count=20, mode=mode))
    outcome = Simulation(recipe, devices).play()
    assert outcome.took_s[10:] == pytest.approx([round_s] * 10, rel=0.35)
    assert [line.clients for line in outcome.run.history[10:]] == [counted] * 10


def test_clients_whose_data_have_other_classes_than_most_are_refused() -> None:
    """In the first round the most decide, and the run's record has the classes; later any other list is refused."""
    decider, run, _ = started(recipe(Mode.SYNC, clients=3), present=3)
    arrived(decider, update("part-000", classes=("Run", "Swim")))
    arrived(decider, update("part-001", classes=("Run", "Walk")))
    wanted = arrived(decider, update("part-002", classes=("Run", "Walk")))
    assert [each.client for each in wanted if isinstance(each, rounds.Refuse)] == ["part-000"]
    (aggregate,) = (each for each in wanted if isinstance(each, rounds.Aggregate))
    assert [share.update.client for share in aggregate.shares] == ["part-001", "part-002"]
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {}), 102.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=1)
    assert after is not None
    assert after.classes == ("Run", "Walk")
    assert after.clients[0].note == "its data have other classes: without Walk and with Swim"
    decider = Decider(after, RoundRecord(run="r", number=2), present=dict.fromkeys(run.recipe.names, "gw"), now=200.0)
    decider.resume(200.0)
    refused = arrived(decider, update("part-000", round=2, classes=("Walk", "Run")), now=201.0)
    assert isinstance(refused[0], rounds.Refuse)
    assert isinstance(arrived(decider, update("part-001", round=2), now=201.0)[0], rounds.Accept)


def test_more_samples_than_the_data_set_has_are_refused() -> None:
    """They would outweigh all others."""
    made = recipe(Mode.SYNC, clients=2)
    clients = tuple(ClientState(name=name) for name in made.names)
    run = RunRecord(id="r", recipe=made, clients=clients, most_samples=96)
    decider = Decider(run, RoundRecord(run="r", number=1), present=dict.fromkeys(made.names, "gw"), now=100.0)
    decider.resume(100.0)
    refused = arrived(decider, update("part-000", samples=97))[0]
    assert isinstance(refused, rounds.Refuse)
    assert refused.reason == "97 samples, the data set has 96"
    assert isinstance(arrived(decider, update("part-001"))[0], rounds.Accept)


def test_updates_of_the_other_side_of_a_partition_count_late_and_once() -> None:
    """They weigh as late ones do, their clients are not ordered beside them, and the record notes that they are in."""
    made = recipe(Mode.PARTIAL, clients=4)
    clients = tuple(ClientState(name=name) for name in made.names)
    run = RunRecord(id="r", recipe=made, clients=clients, round=2, model=Model(number=1, digest="m"), apart=(1,))
    late = Order(client="part-001", round=1, attempt=2, gateway="gw")
    record = RoundRecord(run="r", number=2, base=run.model, orders=(late,))
    apart = [UpdateRecord(client=name, parts=(update(name),)) for name in ("part-000", "part-001")]
    there = dict.fromkeys(made.names, "gw")
    decider = Decider(run, record, apart=apart, present=there, now=100.0)
    wanted = decider.resume(100.0)
    assert [each.record.client for each in wanted if isinstance(each, rounds.Accept)] == ["part-000", "part-001"]
    assert [each.order.client for each in wanted if isinstance(each, rounds.Cancel)] == ["part-001"]
    assert sorted(client for client, _ in sent(wanted)) == ["part-002", "part-003"]
    again = Decider(run, decider.record(100.0), updates=apart, apart=apart, present=there, now=100.0)
    assert not any(isinstance(each, rounds.Accept) for each in again.resume(100.0))
    arrived(decider, update("part-002", round=2))
    wanted = arrived(decider, update("part-003", round=2))
    (aggregate,) = (each for each in wanted if isinstance(each, rounds.Aggregate))
    whole = 96 * 1024
    weights = {share.update.client: share.weight for share in aggregate.shares}
    assert weights == {"part-000": 69511, "part-001": 69511, "part-002": whole, "part-003": whole}
    (close,) = decider.handle(rounds.Aggregated(Model(digest="n"), {}), 102.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=1)
    assert after is not None
    assert after.apart == ()


def test_with_sync_no_update_of_another_side_counts() -> None:
    """As none counts that comes late."""
    made = recipe(Mode.SYNC, clients=2)
    clients = tuple(ClientState(name=name) for name in made.names)
    run = RunRecord(id="r", recipe=made, clients=clients, round=2, apart=(1,))
    apart = [UpdateRecord(client="part-000", parts=(update("part-000"),))]
    decider = Decider(run, RoundRecord(run="r", number=2), apart=apart, present=dict.fromkeys(made.names, "gw"), now=0)
    wanted = decider.resume(0.0)
    assert not any(isinstance(each, rounds.Accept) for each in wanted)
    assert len(sent(wanted)) == 2
    assert decider.record(0.0).merged == (1,)


def test_what_coding_left_over_of_an_update_goes_with_the_client_only_if_it_counted() -> None:
    """Of one that was refused, or lost, the leavings of the update before are kept: nothing of it is in the model."""
    decider, run, _ = started(recipe(Mode.SYNC, clients=2), present=2)
    old = ({"artifact": "0", "bytes": 9, "gateway": "gw"},)
    run = replace(run, clients=tuple(replace(each, residual=(old,), residual_round=7) for each in run.clients))
    new = ({"artifact": "1", "bytes": 9, "gateway": "gw"},)
    for client in run.recipe.names:
        arrived(decider, update(client, coding="int8", residual=new, shards=({"artifact": "2", "bytes": 50},)))
    (close,) = decider.handle(rounds.Aggregated(Model(digest="d"), {"part-001": "norm: too long"}), 102.0)
    assert isinstance(close, rounds.Close)
    after = rounds.closed(run, close.result, now_ns=1)
    assert after is not None
    assert [(each.residual, each.residual_round, each.sent_bytes) for each in after.clients] == [
        ((new,), 1, 50),
        ((old,), 7, 0),
    ]
    assert after.history[-1].sent_bytes == 50


@given(faults(), st.integers(0, 2**20), st.integers(3, 9))
@settings(deadline=None, max_examples=60)
def test_masked_updates_are_summed_with_a_majority_of_their_cohort_only(
    wrong: Faults, seeded: int, clients: int
) -> None:
    """Clients without keys, dropouts, lost files, takeovers: nobody trains without masks, and each round ends."""
    wrong = replace(wrong, refused=0.0) if clients < 6 else wrong
    made = replace(recipe(Mode.SYNC, clients=clients, count=4), update=Update(secagg=True))
    outcome = Simulation(made, devices(clients), faults=wrong, seed_number=seeded).play(most_events=20_000)
    assert outcome.run.state is RunState.SUCCEEDED
    assert outcome.late == 0


def keyed(made: Recipe) -> tuple[Decider, tuple[str, ...]]:
    """A decider whose cohort has masks, and its clients."""
    decider, _, out = started(made)
    make = next(each for each in out if isinstance(each, rounds.MakeKeys))
    keys = tuple(PublicKeys(client=name, gateway="gw", sharing="", masking="") for name in make.clients)
    out = decider.handle(rounds.Keyed(Cohort(epoch="e", clients=keys)), 100.0)
    assert isinstance(out[0], rounds.WriteRound)
    assert [each.order.client for each in out if isinstance(each, rounds.Send)] == list(make.clients)
    return decider, make.clients


def test_a_cohort_agrees_on_masks_before_it_trains() -> None:
    """No order is sent before; where keys cannot be made that is tried again, and the round says why."""
    made = replace(recipe(Mode.SYNC), update=Update(secagg=True))
    decider, _, out = started(made)
    assert not any(isinstance(each, rounds.Send) for each in out)
    assert [each.clients for each in out if isinstance(each, rounds.MakeKeys)] == [made.names]
    assert decider.handle(rounds.Unkeyed("gw-2 does not answer"), 100.0) == []
    assert "part-000 (no masks yet: gw-2 does not answer)" in decider.waits
    at = decider.next_at(100.0)
    assert at is not None
    assert [type(each) for each in decider.advance(at)] == [rounds.MakeKeys]


def test_with_fewer_than_a_majority_another_cohort_trains_anew() -> None:
    """Of eight clients five are needed; with four the round begins again, with new masks and nothing of the old."""
    decider, names = keyed(replace(recipe(Mode.SYNC), update=Update(secagg=True)))
    for name in names[:4]:
        decider.handle(rounds.Arrived("r", update(name, coding="masked")), 101.0)
    for name in names[4:]:
        for attempt in range(1, 4):
            decider.handle(rounds.Failed((name, 1, 0), attempt, "it is broken"), 102.0)
    at = decider.next_at(102.0)
    assert at is not None
    out = decider.advance(at)
    assert [each.record.parts for each in out if isinstance(each, rounds.Accept)] == [()] * 4
    assert [each.clients for each in out if isinstance(each, rounds.MakeKeys)] == [names]
    written = next(each.record for each in out if isinstance(each, rounds.WriteRound))
    assert written.cohort is None
    assert {order.attempt for order in written.orders} == {2, 4}


def test_an_update_without_masks_is_refused_and_one_with_masks_too_where_there_are_none() -> None:
    """It would be summed as noise."""
    decider, names = keyed(replace(recipe(Mode.SYNC), update=Update(secagg=True)))
    out = decider.handle(rounds.Arrived("r", update(names[0])), 101.0)
    assert rounds.Refuse(names[0], "it is not masked") in out
    decider, _, _ = started(recipe(Mode.SYNC))
    out = decider.handle(rounds.Arrived("r", update("part-000", coding="masked")), 101.0)
    assert rounds.Refuse("part-000", "it is masked") in out


def test_with_differential_privacy_all_clients_weigh_the_same_and_epsilon_grows() -> None:
    """Whatever their samples; the history tells what the models so far tell of the client that took part most often."""
    made = replace(recipe(Mode.SYNC, clients=4, count=3), update=Update(dp=Dp(clip=1.0, noise=2.0)))
    various = {name: Device(1.0, 10 * (number + 1)) for number, name in enumerate(made.names)}
    shares: list[int] = []

    class Noted(Simulation):
        def _made(self, aggregate: rounds.Aggregate) -> rounds.Event:
            shares.extend(share.weight for share in aggregate.shares)
            return super()._made(aggregate)

    outcome = Noted(made, various).play()
    assert set(shares) == {1024}
    assert [line.epsilon for line in outcome.run.history] == [privacy.epsilon(2.0, k, 1e-5) for k in (1, 2, 3)]
    plain = Simulation(recipe(Mode.SYNC, clients=4, count=1), devices(4)).play()
    assert plain.run.history[0].epsilon is None
