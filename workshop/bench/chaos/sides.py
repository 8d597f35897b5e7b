"""What is ordered on each side of a partition, fixed beforehand, and what must have become of it. Pure.

Before each cut tasks are handed in whose plans wait for approval; during it operators on both sides approve and cancel
them, and hand in tasks of their own, some under the same id on both sides. Afterwards every gateway must answer the
same for every task, and every order that was answered as done must either show in the record or have been told to its
operator as lost.
"""

import random
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct, field

from appliance.model import TaskRecord, TaskState
from workshop.bench.chaos import plan
from workshop.bench.chaos.plan import Wanted

SUBMIT, APPROVE, CANCEL = "submit", "approve", "cancel"
KINDS = (
    (APPROVE, ""),
    (CANCEL, ""),
    (APPROVE, CANCEL),
    (APPROVE, APPROVE),
    (CANCEL, CANCEL),
    (SUBMIT, ""),
    (SUBMIT, SUBMIT),
)
"""What one side does to a task, and the other; each also the other way round."""
MOST_EVIDENCE = 20

View = tuple[TaskState, str, str]


class Contested(Struct, frozen=True, kw_only=True):
    """A task, and what each side of the partition orders of it ("": nothing)."""

    wanted: Wanted
    orders: tuple[str, str]

    @property
    def submitted(self) -> bool:
        """Whether it is handed in during the cut instead of waiting for approval when it comes."""
        return SUBMIT in self.orders


class Given(Struct, kw_only=True):
    """An order as it was given, and what was answered."""

    task: str
    verb: str
    side: int
    by: str
    act: str
    problem: str = ""
    """Code of the error it was answered with; empty: as done."""


class Cut(Struct, kw_only=True):
    """One partition as it was."""

    seconds: float
    sides: tuple[tuple[str, ...], ...]
    tasks: int = 0
    given: list[Given] = field(default_factory=list[Given])
    met_s: float | None = None
    """From the mended link to when the last gateway saw the last of the other side; None: nobody had missed anybody."""
    agreed_s: float | None = None
    """From the mended link to when all gateways answered the same for every task; None: never."""
    apart: list[str] = field(default_factory=list[str])
    """Tasks of which they did not, and what was said."""

    @property
    def after_met_s(self) -> float | None:
        """From the moment that all saw each other to the same answers."""
        return None if self.agreed_s is None else max(0.0, self.agreed_s - (self.met_s or 0.0))


def contested(cut: int, *, rounds: int, robots: Sequence[str], seed: int) -> tuple[Contested, ...]:
    """Return the tasks of a cut, the same for the same seed: `rounds` of each kind each way round."""
    generator = random.Random(seed * 1000 + cut)  # noqa: S311 - a mixture, not secrets
    orders = [each for one, other in KINDS for each in {(one, other): None, (other, one): None}] * rounds
    generator.shuffle(orders)
    wanted = plan.tasks(len(orders), seconds=0.0, robots=robots, prefix=f"p{seed}-{cut}-", seed=seed * 1000 + cut)
    return tuple(Contested(wanted=each, orders=pair) for each, pair in zip(wanted, orders, strict=True))


def view(record: TaskRecord) -> View:
    """What of a record all gateways must answer alike, whatever a run tells meanwhile."""
    return (
        record.state,
        record.decision.act if record.decision is not None else "",
        record.cancelled_by.act if record.cancelled_by is not None else "",
    )


class Agreement:
    """When gateways that are asked again and again have come to answer the same of each task.

    An answer that differs in one round and no more is a task that moved on between two questions; one that differs
    twice running is a gateway that does not know.
    """

    def __init__(self, tasks: Sequence[str]) -> None:
        self._differs: dict[str, int] = dict.fromkeys(tasks, 2)
        self._what: dict[str, str] = dict.fromkeys(tasks, "not asked yet")
        self.at_s = 0.0
        """When the last difference was seen to be gone."""

    @property
    def apart(self) -> list[str]:
        """Tasks of which not all say the same just now, and what they say."""
        return [f"{task}: {self._what[task]}" for task, rounds in self._differs.items() if rounds]

    def heard(self, task: str, answers: Mapping[str, View | str], at_s: float) -> None:
        """Take in one round of answers (a text: the error in place of one), `at_s` after the link was mended."""
        said = Counter(answers.values())
        if len(said) == 1 and not isinstance(next(iter(said)), str):
            if self._differs[task] > 1:
                self.at_s = at_s
            self._differs[task] = 0
            return
        self._differs[task] += 1
        self._what[task] = "; ".join(
            f"{gateway} {each if isinstance(each, str) else f'{each[0]} {each[1:]}'}"
            for gateway, each in sorted(answers.items())
        )


def effective(given: Given, record: TaskRecord) -> bool:
    """Whether a record shows what an order wanted."""
    match given.verb:
        case "approve":
            return record.decision is not None and record.decision.approved
        case "cancel":
            return record.state in (TaskState.CANCELLED, TaskState.CANCELLING)
        case _:
            return True


def account(
    cuts: Sequence[Cut], records: Mapping[str, TaskRecord | None], notices: Mapping[str, str]
) -> dict[str, Any]:
    """Return what became of the orders.

    Args:
        cuts: the partitions.
        records: by task, in the end.
        notices: recipient by id of each notice that was heard.

    Returns:
        A row for each cut in `cuts`; `lost`: orders answered as done that the record does not show, `told` of them by a
        notice to their operator, and `silently` those that were not (evidence); `missing`: tasks whose submission was
        answered as done and that have no record; `apart`: differences that did not go away.
    """
    lost: list[Given] = []
    silently: list[str] = []
    missing: list[str] = []
    for given in (each for cut in cuts for each in cut.given if not each.problem):
        record = records.get(given.task)
        if record is None:
            missing.append(f"{given.task}: {given.verb} by {given.by} was answered as done, and there is no record")
        elif not effective(given, record):
            lost.append(given)
            if notices.get(f"{given.task}/healed/order-{given.act}") != given.by:
                silently.append(f"{given.verb} of {given.task} by {given.by} ({given.act}): it is {record.state}")
    return {
        "cuts": [_row(cut) for cut in cuts],
        "lost": len(lost),
        "told": len(lost) - len(silently),
        "silently": silently[:MOST_EVIDENCE],
        "missing": missing[:MOST_EVIDENCE],
        "apart": [each for cut in cuts for each in cut.apart][:MOST_EVIDENCE],
    }


def _row(cut: Cut) -> dict[str, Any]:
    return {
        "seconds": cut.seconds,
        "tasks": cut.tasks,
        "orders": [
            dict(Counter(f"{each.verb} {each.problem or 'done'}" for each in cut.given if each.side == side))
            for side in range(len(cut.sides))
        ],
        "met_s": _rounded(cut.met_s),
        "agreed_s": _rounded(cut.agreed_s),
        "agreed_after_met_s": _rounded(cut.after_met_s),
    }


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 3)


def broken(found: Mapping[str, Any], *, within_s: float) -> list[str]:
    """Say what of an account breaks the promise: the same answers within `within_s` of having met, nothing lost."""
    slow = [row for row in found["cuts"] if row["agreed_after_met_s"] is None or row["agreed_after_met_s"] > within_s]
    said = (
        [f"{len(slow)} of {len(found['cuts'])} partitions without the same answers {within_s:g} s after"]
        if slow
        else []
    )
    return said + [
        f"{len(found[kind])} {what}"
        for kind, what in (("silently", "orders lost without a notice"), ("missing", "submissions lost"))
        if found[kind]
    ]
