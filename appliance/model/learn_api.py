"""Requests and replies of the verbs of federated learning. Requests refuse unknown fields."""

from typing import Literal

from msgspec import Struct

from appliance.model import Signed
from appliance.model.learning import (
    ClientState,
    ClientStatus,
    Cohort,
    Order,
    PublicKeys,
    Recipe,
    Reference,
    RoundRecord,
    RunRecord,
)

Steering = Literal["pause", "resume", "stop", "exclude", "include", "mark", "unmark", "remove"]


class LearnStartAsk(Signed, frozen=True, kw_only=True):
    """`learn_start`: begin a run. `id` makes a repeated request the same run."""

    id: str
    recipe: Recipe


class LearnDataAsk(Struct, frozen=True, kw_only=True):
    """`learn_data`: what the asked gateway has of some data sets, by their paths in its folder `learning`."""

    paths: tuple[str, ...]


class DataFound(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A data set at a gateway, by its lists alone."""

    path: str
    classes: tuple[str, ...] = ()
    """In order; empty where the data name none."""
    items: int = 0
    """Listed for training, damaged ones included."""
    missing: str = ""
    """Why it cannot be used; empty: it can."""


class LearnData(Struct, frozen=True, kw_only=True):
    """As many as were asked for, in their order."""

    found: tuple[DataFound, ...]


class LearnRunsAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`learn_runs`: the runs whose records the asked gateway holds; the asker puts together what all hold."""


class LearnRuns(Struct, frozen=True, kw_only=True):
    """Run records, newest first."""

    runs: tuple[RunRecord, ...]


class LearnShowAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`learn_show`: one run. `here` asks the round's coordinator itself."""

    run: str
    here: bool = False


class Working(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An order that is under way, as its coordinator knows it."""

    client: str
    part: int = 0
    helper: str = ""
    gateway: str = ""
    attempt: int = 1
    round: int = 0
    since_s: float = 0.0
    progress: float = 0.0
    note: str = ""
    """What its run told last, or why it is not sent yet, or waits at its gateway."""
    queued: bool = False
    """Whether its gateway has taken it, and has no container for it yet."""


class LearnShown(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A run, its round, and what its coordinator knows beside them."""

    run: RunRecord
    round: RoundRecord | None = None
    coordinator: str = ""
    successor: str = ""
    """Who coordinates the round if the coordinator goes."""
    working: tuple[Working, ...] = ()
    clients: tuple[ClientStatus, ...] = ()
    elapsed_s: float = 0.0


class ClientWhy(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Why a client is where it is: what the run knows of it, what it is at, its orders (`swiftbot learn why`)."""

    client: ClientState
    status: ClientStatus
    working: tuple[Working, ...] = ()
    """Orders under way of its own, or in which it helps."""
    given_up: tuple[Order, ...] = ()
    """Its orders that are not awaited any more, with the reason."""
    deadline_s: float | None = None
    """Of the open round."""


class LearnSteerAsk(Signed, frozen=True, kw_only=True):
    """`learn_steer`: pause, resume, stop or remove a run, exclude a client or take it back, keep a model or not."""

    run: str
    do: Steering
    client: str = ""
    model: int = 0


class LearnEvalAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`learn_eval`: which model of a run (None: the newest), on how many items at most (None: all)."""

    run: str
    model: int | None = None
    limit: int | None = None


class LearnEvaluated(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What an evaluation gave; of transcriptions the accuracy is 1 less the word error rate."""

    run: str
    model: int
    accuracy: float
    loss: float | None
    items: int


class LearnExportAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`learn_export`: write a model of a run (None: the newest) in another format."""

    run: str
    model: int | None = None
    format: Literal["onnx"] = "onnx"


class LearnExported(Struct, frozen=True, kw_only=True):
    """A model's file, and what PyTorch made of some inputs with it: `[{input, output, values}]` (`samples.sample`)."""

    run: str
    model: int
    file: Reference
    checks: Reference


# --- secure aggregation (`learn.secagg`)


class Sealed(Struct, frozen=True, kw_only=True):
    """A client's shares of its two secrets for another client, encrypted for that one; hex."""

    of: str
    to: str
    data: str


class Revealed(Struct, frozen=True, kw_only=True):
    """A share that is given away, in hex: of a client that is summed of its own mask, of another of its mask key."""

    of: str
    x: int
    y: str


class LearnKeysAsk(Struct, frozen=True, kw_only=True):
    """`learn_keys`: make keys for clients of the asked gateway."""

    epoch: str
    clients: tuple[str, ...]


class LearnKeys(Struct, frozen=True, kw_only=True):
    """Their public keys."""

    keys: tuple[PublicKeys, ...]


class LearnShareAsk(Struct, frozen=True, kw_only=True):
    """`learn_share`: cut the secrets of the asked gateway's clients for a cohort."""

    cohort: Cohort


class LearnShares(Struct, frozen=True, kw_only=True):
    """The shares, each encrypted for one client."""

    sealed: tuple[Sealed, ...]


class LearnHoldAsk(Struct, frozen=True, kw_only=True):
    """`learn_hold`: this is the cohort, these are the shares of others for the asked gateway's clients."""

    cohort: Cohort
    sealed: tuple[Sealed, ...]


class LearnHeld(Struct, frozen=True, kw_only=True):
    """How many clients of the cohort are at the asked gateway."""

    clients: int


class LearnUnmaskAsk(Struct, frozen=True, kw_only=True):
    """`learn_unmask`: give away the shares that the sum of these clients' updates needs."""

    epoch: str
    summed: tuple[str, ...]


class LearnUnmasked(Struct, frozen=True, kw_only=True):
    """The shares that the asked gateway's clients hold."""

    revealed: tuple[Revealed, ...]
