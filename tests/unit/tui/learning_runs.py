"""A run of federated learning under way, and one that has ended, for the screens' tests."""

from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from appliance.model.learn_api import LearnShown
from appliance.model.learning import (
    Activity,
    Clients,
    ClientState,
    ClientStatus,
    Closed,
    Mode,
    Model,
    Order,
    Recipe,
    RoundRecord,
    Rounds,
    RunRecord,
    RunState,
)

if TYPE_CHECKING:
    from .conftest import FakeView

NAMES = ("rover_1", "rover_2", "drone_1", "drone_2")
RECIPE = Recipe(model="clips", clients=Clients(robots=NAMES), rounds=Rounds(count=40, target=0.9, mode=Mode.PARTIAL))
HISTORY = tuple(
    Closed(
        number=number, took_s=10.0 + number % 3, all_s=41.0, clients=4, samples=384, loss=2.4 / number,
        accuracy=0.1 + 0.1 * number, digest="d" * 16, why="deadline",
    )
    for number in range(1, 7)
)  # fmt: skip
RUN = RunRecord(
    id="clips-1", recipe=RECIPE, round=7, model=Model(number=6, digest="ab" * 16, gateways=("gw-a", "gw-b")),
    clients=tuple(ClientState(name=name, samples=96, epoch_s=8.0, rounds=6) for name in NAMES),
    history=HISTORY, started_ns=2, updated_ns=9,
)  # fmt: skip
ENDED = replace(RUN, id="words-1", state=RunState.STOPPED, why="stopped by ann", started_ns=1, history=(), round=1)
ROUND = RoundRecord(
    run="clips-1", number=7, target=4, elapsed_s=6.0, deadline_s=13.0, coordinator="gw-b", successor="gw-a",
    waits="2 of 4 clients: rover_1, rover_2", orders=(Order(client="rover_1", round=7, gateway="gw-a"),),
)  # fmt: skip


def status(client: str, state: Activity, **more: Any) -> ClientStatus:
    """Return what a client of the run is at."""
    return ClientStatus(run="clips-1", client=client, round=7, state=state, samples=96, samples_s=12.0, **more)


STATUSES = (
    status("rover_1", Activity.TRAINING, gateway="gw-a", progress=0.4, eta_s=4.8, why="step 3/6, loss 0.41"),
    status("rover_2", Activity.LATE, gateway="gw-b", progress=0.7, staleness=2, eta_s=1.0),
    status("drone_1", Activity.DONE, gateway="gw-b"),
    status("drone_2", Activity.ABSENT, why="drone_2 is not there"),
)


def fill(view: "FakeView") -> None:
    """Put both runs into a view, and have it answer for the one under way."""
    for run in (RUN, ENDED):
        view.store.take_learn_run(run)
    view.store.take_round(ROUND)
    for each in STATUSES:
        view.store.take_client(each)
    view.orders.answers["learn_show"] = LearnShown(
        run=RUN, round=ROUND, coordinator="gw-b", successor="gw-a", clients=STATUSES, elapsed_s=6.5
    )
