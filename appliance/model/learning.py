"""Federated learning: the recipe of a run, and its records in the DHT.

A **run** trains one model over the fleet, round by round (`learn/{run}`, RunRecord). In a **round** (`learn/{run}/{n}`,
RoundRecord) each client of the cohort is ordered to train the round's base model on its own data; what it sends back is
an **update** (`learn/{run}/{n}/{client}`, UpdateRecord). The round closes when the updates have become the next model
and the run's record says so: model n is the one that n closed rounds have made.
"""

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, field

from appliance.model.messages import OpenEnum

Reference = dict[str, Any]
"""What stands for a file: `{"artifact": sha256, "name", "media_type", "bytes", "gateway"}`."""

MOST_CLIENTS = 1000
"""Clients of a run: its record has a line for each."""
MOST_ROUNDS = 100_000


class Data(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`[data]`: where clients find their samples, one of `name` and `folder`, and who else may see them."""

    name: str = ""
    """Data set in the gateways' folder `learning`; empty, and no folder: named as the model is."""
    folder: str = ""
    """Folder in it, of the layout of UCF101 or LibriSpeech. With robots `{robot}` stands for a robot's name, here and
    in `name`: without it the data at a gateway are those of one robot."""
    share: Literal["never", "gateway", "fleet"] = "never"
    """Whether samples of a client may be trained on elsewhere when it is slow: not at all, by others at its gateway, or
    by any gateway."""


class Clients(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`[clients]`: robots, or so many parts of one data set, and how they are chosen."""

    robots: tuple[str, ...] = ()
    """Robots, each with data of its own at its gateway."""
    partitions: Annotated[int, Meta(ge=0, le=MOST_CLIENTS)] = 0
    """In place of robots: the data set is split among so many clients."""
    by: str = "dirichlet:0.5"
    """How it is split: `speaker`, `site`, `even`, or `dirichlet:ALPHA`, the smaller the less alike clients are."""
    per_round: Annotated[int, Meta(ge=0, le=MOST_CLIENTS)] = 0
    """Clients that a round waits for; 0: all."""
    over_selection: Annotated[float, Meta(ge=1, le=3)] = 1.0
    """So many times as many are chosen."""
    fair_after: Annotated[int, Meta(ge=1)] = 3
    """A client that was left out for so many rounds is preferred."""


class Optimiser(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`optimiser`: how a client makes steps."""

    name: Literal["sgd", "adam"] = "sgd"
    lr: Annotated[float, Meta(gt=0, le=10)] = 0.05
    momentum: Annotated[float, Meta(ge=0, lt=1)] = 0.9


class Training(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`[training]`: what a client does in a round."""

    epochs: Annotated[int, Meta(ge=1, le=1000)] = 1
    batch: Annotated[int, Meta(ge=1, le=4096)] | None = None
    """None: the model's own."""
    optimiser: Optimiser | None = None
    """None: the model's own."""
    checkpoint_steps: Annotated[int, Meta(ge=0)] = 0
    """Steps between two checkpoints, from which a run that is moved or repeated goes on; 0: the handler's own."""


class Mode(OpenEnum):
    """When a round closes, and what becomes of slow clients."""

    AUTO = "auto"
    """`offload` where `data.share` allows it, else `partial`; with secure aggregation `sync`."""
    SYNC = "sync"
    """Waits for all (FedAvg)."""
    BUFFERED = "buffered"
    """Closes when `close_at` of them have answered; later updates count in later rounds, with less weight (FedBuff)."""
    PARTIAL = "partial"
    """Slow clients stop at the deadline and send what they have, normalised to a whole epoch (FedNova)."""
    OFFLOAD = "offload"
    """Slow clients train what they can; others that are idle train on the rest of their samples."""


class Rounds(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`[rounds]`: how many, and when one closes."""

    count: Annotated[int, Meta(ge=1, le=MOST_ROUNDS)] = 40
    """The run has succeeded after so many."""
    target: Annotated[float, Meta(gt=0, le=1)] | None = None
    """Or as soon as the model's accuracy is this."""
    mode: Mode = Mode.AUTO
    close_at: Annotated[float, Meta(gt=0, le=1)] = 0.75
    """Share of the clients, with mode `buffered`."""
    max_staleness: Annotated[int, Meta(ge=0, le=100)] = 5
    """Rounds that an update may be late and still count."""
    deadline: Annotated[float, Meta(ge=1, le=100)] = 1.3
    """Times the median of what the clients take for a whole epoch."""
    timeout_s: Annotated[float, Meta(gt=0, le=86_400)] = 3600.0
    """Longest that one client is waited for."""
    at_least: Annotated[int, Meta(ge=1)] = 1
    """Clients whose updates a model needs."""


class Dp(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`dp`: differential privacy of clients."""

    clip: Annotated[float, Meta(gt=0, le=1e6)]
    """Longest update: its norm is cut to this. All clients weigh the same."""
    noise: Annotated[float, Meta(ge=0.01, le=1e6)]
    """Standard deviation of the noise in the sum, as a multiple of `clip`."""
    delta: Annotated[float, Meta(gt=0, lt=1)] = 1e-5
    """At which ε is told."""


class Update(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`[update]`: how updates become one."""

    rule: str = "mean"
    """`mean`, `median`, `trimmed:SHARE` or `multikrum:HOSTILE`."""
    compression: Literal["none", "int8"] = "none"
    """How clients send their updates: as they are, or in 8 bits, with what that rounds off added to the next one."""
    secagg: bool = False
    """Secure aggregation: clients mask their updates, only the sum can be read. With mode `sync` and robots."""
    dp: Dp | None = None
    """Differential privacy: updates are clipped, and noise is added to their sum. With rule `mean`."""


class Evaluation(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`[evaluation]`: how often the model is evaluated on the data set's test part."""

    every: Annotated[int, Meta(ge=0)] = 1
    """Rounds between two; 0: never."""
    limit: Annotated[int, Meta(ge=1)] | None = None
    """Items at most."""
    data: str = ""
    """Data set in the gateways' folder `learning`; empty: that of the clients."""


class Emulation(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`[emulation]`: clients as slow as other devices, for benchmarks: a batch takes speed x nominal at least."""

    nominal_batch_s: Annotated[float, Meta(gt=0, le=600)] | None = None
    speeds: dict[str, Annotated[float, Meta(ge=0.01, le=1000)]] = field(default_factory=dict[str, float])
    """Client -> how many times as long as nominal a batch takes; 1 for those not listed."""


class Recipe(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """Everything about a run that is known beforehand, from one TOML file."""

    model: str
    """A model's folder: one of the product's (`clips`, `words`, `sentences`), or of the gateways' skills."""
    seed: Annotated[int, Meta(ge=0, lt=2**53)] = 1
    keep_models: Annotated[int, Meta(ge=1, le=1000)] = 3
    """Newest models that are kept; those that are marked stay as well."""
    data: Data = field(default_factory=Data)
    clients: Clients = field(default_factory=Clients)
    training: Training = field(default_factory=Training)
    rounds: Rounds = field(default_factory=Rounds)
    update: Update = field(default_factory=Update)
    evaluation: Evaluation = field(default_factory=Evaluation)
    emulation: Emulation = field(default_factory=Emulation)

    @property
    def mode(self) -> Mode:
        """The mode in force."""
        if self.rounds.mode is not Mode.AUTO:
            return self.rounds.mode
        if self.update.secagg:
            return Mode.SYNC
        return Mode.PARTIAL if self.data.share == "never" else Mode.OFFLOAD

    @property
    def names(self) -> tuple[str, ...]:
        """The clients' names, in order."""
        return self.clients.robots or tuple(f"part-{number:03d}" for number in range(self.clients.partitions))


# --- records


class RunState(OpenEnum):
    """Life of a run. The last three are final."""

    RUNNING = "running"
    PAUSED = "paused"
    """No client is ordered, no round closes; updates that come are kept."""
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    STOPPED = "stopped"

    @property
    def final(self) -> bool:
        """Whether nothing will follow."""
        return self in (RunState.SUCCEEDED, RunState.FAILED, RunState.STOPPED)


class Model(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A model as files. `number` rounds have made it; of model 0 there are no files: clients draw it from the seed."""

    number: int = 0
    digest: str = ""
    """Of its content (`shards.Manifest.digest`)."""
    manifest: Reference | None = None
    shards: tuple[Reference, ...] = ()
    gateways: tuple[str, ...] = ()
    """That hold it."""
    accuracy: float | None = None
    loss: float | None = None
    """On the test part, where it was evaluated."""
    marked: bool = False
    """Whether it is kept whatever comes after it."""


class ClientState(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a run knows of a client."""

    name: str
    epoch_s: float | None = None
    """What a whole epoch takes it, by the last ones; None: not known yet."""
    samples: int = 0
    """It holds, as it said last."""
    rounds: int = 0
    """Rounds in which an update of it counted."""
    chosen: int = 0
    """The round for which it was chosen last; 0: none."""
    refused: int = 0
    """Updates of it that were refused in a row."""
    excluded: str = ""
    """Why it takes part no more; empty: it does."""
    loss: float | None = None
    """Training loss it told last."""
    note: str = ""
    """Why its last update was refused or did not come."""
    sent_bytes: int = 0
    """Size of its last update that counted, as files."""
    residual: tuple[tuple[Reference, ...], ...] = ()
    """What coding left over of that update, to be added to its next one: the files of each of its parts."""
    residual_round: int = 0
    """For which that update was ordered: its files are kept as long as they are needed."""


class Closed(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A line of a run's history."""

    number: int
    took_s: float
    all_s: float = 0.0
    """What waiting for every client of the cohort would have taken, as far as it is known."""
    clients: int = 0
    samples: int = 0
    loss: float | None = None
    """Mean training loss of the clients, by samples."""
    accuracy: float | None = None
    digest: str = ""
    why: str = ""
    sent_bytes: int = 0
    """Size of the updates that counted, as files."""
    epsilon: float | None = None
    """With differential privacy: ε of the models so far, for the client that took part most often. None: above 500."""


class RunRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """`learn/{run}`."""

    id: str
    recipe: Recipe
    state: RunState = RunState.RUNNING
    round: int = 1
    """The round that is open, or was last."""
    model: Model = field(default_factory=Model)
    """The newest: of `round - 1` rounds, or `round` when the run has ended."""
    clients: tuple[ClientState, ...] = ()
    history: tuple[Closed, ...] = ()
    """Of the last rounds, oldest first."""
    models: tuple[Model, ...] = ()
    """Those that are kept, oldest first, the newest among them."""
    classes: tuple[str, ...] = ()
    """What the model tells apart, in order; empty until the first round is closed."""
    most_samples: int = 0
    """That a client can have: items of the largest data set that was found at the start; 0: not known."""
    apart: tuple[int, ...] = ()
    """Rounds that the other side of a partition has closed with other models, whose updates may still count here."""
    why: str = ""
    """Why it is paused, stopped or has failed."""
    by: str = ""
    """Who started it."""
    started_ns: int = 0
    updated_ns: int = 0


class Order(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One client's work for a round, or a part of it that another does: run `{run}.{round}/{subtask}/{attempt}`."""

    client: str
    """Whose samples."""
    round: int
    """For which it was ordered: its base is that round's."""
    part: int = 0
    """0: the client's own; above: parts that were offloaded."""
    share: tuple[float, float] = (0.0, 1.0)
    """Which of the client's samples, from and to, as shares of all in their order."""
    helper: str = ""
    """Who trains instead of the client."""
    attempt: int = 1
    failures: int = 0
    """Attempts that failed of themselves, and not for what passes."""
    refused: int = 0
    """Updates for it that were refused in a row."""
    gateway: str = ""
    """Where it was sent last; empty: not sent yet."""
    stop_at_s: float | None = None
    """When to stop and send what there is."""
    ordered_s: float = 0.0
    """The round's time when it was ordered (of one that is late: 0)."""
    given_up: str = ""
    """Why it is not awaited any more; empty: it is."""

    @property
    def subtask(self) -> str:
        """Its name among the orders of a round."""
        return self.client if not self.part else f"{self.client}.{self.part}"


class PartialUpdate(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a client, or a helper for a part of its samples, has sent."""

    client: str
    round: int
    """For which it was ordered."""
    part: int = 0
    helper: str = ""
    attempt: int = 1
    refused: int = 0
    """Updates for the same order that were refused before it."""
    gateway: str = ""
    manifest: Reference = field(default_factory=dict[str, Any])
    shards: tuple[Reference, ...] = ()
    coding: Literal["none", "int8", "masked"] = "none"
    residual: tuple[Reference, ...] = ()
    """What coding left over of it."""
    samples: int = 0
    """Of the part."""
    steps: int = 0
    steps_whole: int = 0
    """Steps that the part would have taken."""
    loss: float | None = None
    classes: tuple[str, ...] = ()
    """Of its data, in order, where they are not the run's (`RunRecord.classes`)."""
    share: tuple[float, float] = (0.0, 1.0)
    """Which of the client's samples it was to train on (`Order.share`)."""
    took_s: float = 0.0
    """From the order to the update, by the coordinator's clock."""
    train_s: float | None = None
    """Of it spent on steps, as its handler says; None: all."""


class UpdateRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """`learn/{run}/{n}/{client}`: what of a client counts in round n; parts of its samples are summed."""

    client: str
    parts: tuple[PartialUpdate, ...] = ()


class Counted(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What became of a client in a closed round."""

    client: str
    samples: int = 0
    weight: int = 0
    staleness: int = 0
    took_s: float = 0.0
    loss: float | None = None
    sent_bytes: int = 0
    refused: str = ""
    """Why its update did not count: it is unfit, or was left out."""


class PublicKeys(Struct, frozen=True, kw_only=True):
    """A client of a cohort with secure aggregation: the gateway that has its secrets, and its public keys in hex."""

    client: str
    gateway: str
    sharing: str
    """For shares of secrets."""
    masking: str
    """For the masks that it has in common with others."""


class Cohort(Struct, frozen=True, kw_only=True):
    """The clients whose masks cancel in a sum."""

    epoch: str
    """Names their keys; drawn for each cohort."""
    clients: tuple[PublicKeys, ...]


class Side(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How one side of a partition has closed a round."""

    model: str
    counted: tuple[Counted, ...] = ()


class RoundRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """`learn/{run}/{n}`."""

    run: str
    number: int
    base: Model = field(default_factory=Model)
    orders: tuple[Order, ...] = ()
    """The cohort's, parts for helpers, and those of rounds before that are still awaited."""
    target: int = 0
    """Clients that it waits for; 0: the cohort is not chosen yet."""
    cohort: Cohort | None = None
    """With secure aggregation, once its clients have keys."""
    elapsed_s: float = 0.0
    """Since it opened, when this was written."""
    deadline_s: float | None = None
    coordinator: str = ""
    successor: str = ""
    """Who coordinates the round if the coordinator goes, when this was written."""
    waits: str = ""
    """What it waits for, in words."""
    closed: bool = False
    closed_by: str = ""
    """Why it closed: all have answered, the deadline, …"""
    counted: tuple[Counted, ...] = ()
    model: str = ""
    """Digest of the model it made."""
    sides: tuple[Side, ...] = ()
    """Where two sides of a partition have closed it: how each did."""
    merged: tuple[int, ...] = ()
    """Rounds of another side (`RunRecord.apart`) whose updates this one has taken in."""


# --- news, for those who watch and for logs: numbers as fields, so that they can be plotted


class Activity(OpenEnum):
    """What a client is at."""

    IDLE = "idle"
    """Not chosen for the open round."""
    WAITING = "waiting"
    """Chosen; no container has begun yet."""
    TRAINING = "training"
    LATE = "late"
    """Still at work for a round before."""
    DONE = "done"
    """Its update is accepted."""
    LEFT_OUT = "left out"
    """What it was ordered was given up."""
    ABSENT = "absent"
    EXCLUDED = "excluded"
    ENDED = "ended"
    """The run has ended."""


class ClientStatus(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """`learn/{run}/client/{client}`: a client in the open round."""

    run: str
    client: str
    """A robot, or a part of a data set."""
    round: int
    """The open round."""
    state: Activity
    gateway: str = ""
    """Where it trains; of a robot that does not, where it is."""
    attempt: int = 0
    progress: float = 0.0
    """Of its order, 0 to 1."""
    samples: int = 0
    """It holds; 0: not known yet."""
    samples_s: float | None = None
    """Samples a second, as learned in the rounds before; None: not known yet."""
    epoch_s: float | None = None
    """What a whole epoch takes it."""
    eta_s: float | None = None
    """Seconds until its update, when this was put; None: it has no order, or nothing is known."""
    staleness: int = 0
    """Rounds that its order is late."""
    parts: int = 0
    """Parts of its samples that others train at this moment."""
    rounds: int = 0
    """Rounds in which its updates counted."""
    loss: float | None = None
    """Training loss it told last."""
    why: str = ""
    """Why it waits, is left out or excluded, whom it helps, or what its run told last."""


class RunMetric(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """`learn/{run}/metric`: a closed round in numbers."""

    run: str
    round: int
    took_s: float
    all_s: float = 0.0
    """What waiting for every client of the cohort would have taken, as far as it is known."""
    clients: int = 0
    samples: int = 0
    loss: float | None = None
    """Mean training loss."""
    accuracy: float | None = None
    """On the test part; None: not evaluated, or not yet."""
    test_loss: float | None = None
    epsilon: float | None = None
    """With differential privacy: ε of the models so far."""
