"""What clients are at, and a closed round in numbers, by records and what a coordinator knows."""

from appliance.learn.status import metric, statuses
from appliance.model.learn_api import Working
from appliance.model.learning import (
    Activity,
    Clients,
    ClientState,
    ClientStatus,
    Closed,
    Model,
    Order,
    Recipe,
    RoundRecord,
    RunRecord,
    RunState,
)

RECIPE = Recipe(model="clips", clients=Clients(robots=("rover_1", "rover_2", "rover_3")))
STATES = tuple(ClientState(name=name, epoch_s=10.0, samples=100) for name in RECIPE.names)
RUN = RunRecord(id="r", recipe=RECIPE, round=3, clients=STATES)
PLACES = {"rover_1": "gw-1", "rover_2": "gw-2", "rover_3": "gw-2"}


def first(*working: Working, record: RoundRecord | None = None, run: RunRecord = RUN, **more: object) -> ClientStatus:
    """Return what the first client is at."""
    return statuses(run, record, working, **({"places": PLACES} | more))[0]  # pyright: ignore[reportArgumentType]


def ordered(**order: object) -> RoundRecord:
    """Return a round in which the first client has an order."""
    return RoundRecord(run="r", number=3, orders=(Order(client="rover_1", round=3, **order),))  # pyright: ignore[reportArgumentType]


def test_a_client_that_trains_has_its_place_progress_speed_and_time_left() -> None:
    """Half done after 4 s: 4 s more; its speed is that of the rounds before."""
    working = Working(client="rover_1", gateway="gw-1", round=3, attempt=2, since_s=4.0, progress=0.5, note="step 3/6")
    found = first(working, record=ordered())
    assert (found.state, found.gateway, found.attempt, found.progress) == (Activity.TRAINING, "gw-1", 2, 0.5)
    assert (found.samples, found.samples_s, found.eta_s, found.why) == (100, 10.0, 4.0, "step 3/6")


def test_before_a_step_is_told_the_time_left_is_that_of_the_rounds_before_and_never_beyond_the_deadline() -> None:
    """An epoch of 10 s after 2 s has 8 s left; of half the samples 3; told to stop at 6 s, 4."""
    working = Working(client="rover_1", gateway="gw-1", round=3, since_s=2.0)
    assert first(working, record=ordered()).eta_s == 8.0
    assert first(working, record=ordered(share=(0.0, 0.5))).eta_s == 3.0
    assert first(working, record=ordered(stop_at_s=6.0)).eta_s == 4.0


def test_a_client_that_was_not_sent_yet_waits_with_the_reason() -> None:
    """Without a gateway it has none, and the note says why."""
    working = Working(client="rover_1", round=3, note="gw-1: no container is free")
    found = first(working, record=ordered())
    assert (found.state, found.why) == (Activity.WAITING, "gw-1: no container is free")


def test_a_late_client_shows_by_how_many_rounds() -> None:
    """Its order is of round 1 while round 3 is open."""
    found = first(Working(client="rover_1", gateway="gw-1", round=1, since_s=9.0))
    assert (found.state, found.staleness) == (Activity.LATE, 2)


def test_a_helper_shows_whom_it_helps_and_the_helped_how_many_parts_others_train() -> None:
    """A part of the second client's samples is with the first."""
    part = Working(client="rover_2", part=1, helper="rover_1", gateway="gw-2", round=3)
    found = statuses(RUN, ordered(), (part,), places=PLACES)
    assert (found[0].state, found[0].why, found[0].gateway) == (Activity.TRAINING, "helps rover_2", "gw-2")
    assert (found[0].parts, found[1].parts, found[1].state) == (0, 1, Activity.IDLE)


def test_accepted_absent_left_out_excluded_and_ended_are_told_apart() -> None:
    """Each with its reason; of a robot that is there its gateway."""
    assert first(accepted={"rover_1"}).state is Activity.DONE
    assert first().state is Activity.IDLE
    assert first().gateway == "gw-1"
    gone = first(places={})
    assert (gone.state, gone.why) == (Activity.ABSENT, "rover_1 is not there")
    assert first(places=None).state is Activity.IDLE
    out = first(record=ordered(given_up="no answer within 60 s"))
    assert (out.state, out.why) == (Activity.LEFT_OUT, "no answer within 60 s")
    excluded = RunRecord(id="r", recipe=RECIPE, clients=(ClientState(name="rover_1", excluded="by anna"),))
    assert (first(run=excluded).state, first(run=excluded).why) == (Activity.EXCLUDED, "by anna")
    ended = RunRecord(id="r", recipe=RECIPE, clients=STATES, state=RunState.STOPPED)
    assert first(Working(client="rover_1", gateway="gw-1", round=1), run=ended).state is Activity.ENDED


def test_a_closed_round_is_told_in_numbers() -> None:
    """Those of the history, with the test loss of its model where it is kept; None of a round that is not there."""
    line = Closed(number=2, took_s=1.5, all_s=6.0, clients=3, samples=300, loss=0.4, accuracy=0.8)
    run = RunRecord(id="r", recipe=RECIPE, history=(line,), model=Model(number=2, loss=0.5))
    found = metric(run, 2)
    assert found is not None
    assert (found.took_s, found.all_s, found.loss, found.accuracy, found.test_loss) == (1.5, 6.0, 0.4, 0.8, 0.5)
    assert metric(run, 1) is None
