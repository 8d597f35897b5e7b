"""Schedules of instructions and saved instructions: their records, and the requests about them."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from appliance.model.steering import Signed, Word
from appliance.model.tasks import HIGHEST_PRIORITY, LONGEST_DEADLINE_S, PLAIN_PRIORITY, Approval

SHORTEST_S = 10.0
"""Of the interval of a schedule."""
LONGEST_S = 366 * 86_400.0
MAX_INSTRUCTION = 4000

Text = Annotated[str, Meta(min_length=1, max_length=MAX_INSTRUCTION)]


class ScheduleSpec(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """What is to be submitted and when: exactly one of `every_s`, `cron` and `at_ns` is given."""

    id: str
    """Its name."""
    instruction: Text
    every_s: Annotated[float, Meta(ge=0, le=LONGEST_S)] = 0.0
    """Interval, counted from when it was added."""
    cron: Annotated[str, Meta(max_length=200)] = ""
    """Five fields: minute, hour, day of month, month, day of week; by the clock of `zone`."""
    at_ns: Annotated[int, Meta(ge=0, le=2**62)] = 0
    """Once, Unix nanoseconds."""
    zone: Annotated[str, Meta(max_length=80)] = "UTC"
    """IANA name, such as Europe/Zurich."""
    until_ns: Annotated[int, Meta(ge=0, le=2**62)] = 0
    """After it nothing is submitted, nothing that was missed either, Unix nanoseconds; 0: no end."""
    late: Literal["report", "run"] = "report"
    """What becomes of one that was missed: an alert alone, or the last missed one is submitted late as well."""
    grace_s: Annotated[float, Meta(ge=1, le=86_400)] = 60.0
    """How late it may be submitted and is not missed."""
    overlap: Literal["skip", "allow"] = "skip"
    """While the task of the time before has not ended: the next one is missed, or submitted all the same."""
    priority: Annotated[int, Meta(ge=0, le=HIGHEST_PRIORITY)] = PLAIN_PRIORITY
    deadline_s: Annotated[float, Meta(ge=0, le=LONGEST_DEADLINE_S)] = 0.0
    group: Annotated[tuple[str, ...], Meta(max_length=64)] = ()
    approval: Approval = Approval.NEVER


class Schedule(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A schedule as it stands in the DHT under `schedule/{id}`."""

    spec: ScheduleSpec
    added: Word
    """Who added it, and why: its tasks are submitted in that operator's name."""
    paused: Word | None = None
    removed: Word | None = None
    """Who removed it, and why. It is over; the record stays for a time, so that an old copy does not bring it back."""
    edited_ns: int = 0
    """When an operator changed it last, Unix nanoseconds."""
    handled_ns: int = 0
    """Up to here every time that was due has been submitted, or missed."""
    fired: int = 0
    """Tasks submitted so far."""
    fired_ns: int = 0
    """When the last of them was due."""
    task: str = ""
    """The last of them."""
    missed: int = 0
    """Times that nothing was submitted though it was due."""
    missed_ns: int = 0
    """The last of them."""
    missed_why: str = ""

    @property
    def id(self) -> str:
        """Its name."""
        return self.spec.id


class ScheduleAdd(Signed, frozen=True, kw_only=True):
    """`schedule_add`: a new schedule; the same again is the same one."""

    spec: ScheduleSpec

    @property
    def id(self) -> str:
        """Its name, for the audit."""
        return self.spec.id


class ScheduleSteer(Signed, frozen=True, kw_only=True):
    """`schedule_steer`: pause, resume or remove one."""

    id: str
    do: Literal["pause", "resume", "remove"]


class SchedulesAsk(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`schedules`: all, or those whose records are the asked gateway's (`local`)."""

    local: bool = False


class ScheduleShown(Struct, frozen=True, kw_only=True):
    """A schedule, and when it is due next."""

    schedule: Schedule
    next_ns: tuple[int, ...] = ()
    """The next times, Unix nanoseconds; none: it is over, or paused."""
    owner: str = ""
    """The gateway that submits its tasks."""


class ScheduleList(Struct, frozen=True, kw_only=True):
    """Schedules by name; `unreachable` names gateways that did not answer."""

    schedules: tuple[ScheduleShown, ...] = ()
    unreachable: tuple[str, ...] = ()


class SavedInstruction(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An instruction with parameters, as it stands in the DHT under `instruction/{id}`."""

    id: str
    text: Text
    """With parameters as `{name}`, or `{name=default}`."""
    about: Annotated[str, Meta(max_length=400)] = ""
    saved: Word | None = None


class InstructionSave(Signed, frozen=True, kw_only=True):
    """`instruction_save`: save or replace one."""

    id: str
    text: Text
    about: Annotated[str, Meta(max_length=400)] = ""
    replace: bool = False
    """Whether one of that name may be replaced."""


class InstructionRemove(Signed, frozen=True, kw_only=True):
    """`instruction_remove`: remove one; answers with what it was."""

    id: str


class InstructionsAsk(Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """`instructions`: all saved ones, or those whose records are the asked gateway's (`local`)."""

    local: bool = False


class InstructionList(Struct, frozen=True, kw_only=True):
    """Saved instructions by name; `unreachable` names gateways that did not answer."""

    instructions: tuple[SavedInstruction, ...] = ()
    unreachable: tuple[str, ...] = ()
