"""What an operator orders of tasks over RPC: the request and reply structs of the verbs.

    approve      ApproveAsk -> TaskRecord       let a plan that waits take effect, as it is or edited
    reject       RejectAsk -> TaskRecord        turn it down
    plan_check   PlanCheckAsk -> PlanChecked    what is wrong with a plan, and its hash; runs nothing
    pause        PauseAsk -> TaskRecord         start no further subtask
    resume       ResumeAsk -> TaskRecord        go on
    retry        RetryAsk -> TaskRecord         try again what has failed; what has succeeded is kept
    cancel       CancelTaskAsk -> TaskRecord    stop it
    answer       AnswerAsk -> Enquiry           answer a question of a skill or robot; the first answer counts
    enquiries    EnquiriesAsk -> EnquiryList    the questions that wait for an answer
    acts         ActsAsk -> ActList             what operators ordered of the asked gateway lately

Each may be asked at any gateway; `here` is for gateways among themselves.
"""

from typing import Annotated

from msgspec import Meta, Struct

from appliance.model import Act, Enquiry, Plan, Signed

MAX_ANSWER = 2000


class ApproveAsk(Signed, frozen=True, kw_only=True):
    """`approve`: the plan with that hash (8 characters of it at least), or `plan` in its place.

    Without a hash whatever waits is approved: for programs that have just read the record.
    """

    id: str
    hash: Annotated[str, Meta(max_length=64)] = ""
    plan: Plan | None = None
    """The plan as edited; checked like any plan before it is taken."""
    here: bool = False


class RejectAsk(Signed, frozen=True, kw_only=True):
    """`reject`: a task whose first plan is turned down is cancelled, one with a new plan after a failure fails."""

    id: str
    hash: Annotated[str, Meta(max_length=64)] = ""
    here: bool = False


class PlanCheckAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`plan_check`: is this plan valid just now; with a task, in place of the one that waits there?"""

    plan: Plan
    task: str = ""


class PlanChecked(Struct, frozen=True, kw_only=True):
    """What is wrong with the plan, a sentence each; its hash; and why it would have to be approved, if it would."""

    problems: tuple[str, ...]
    hash: str
    approval: str = ""


class PauseAsk(Signed, frozen=True, kw_only=True):
    """`pause`: no subtask is started. With `hold`, runs whose skill saves checkpoints are ended and go on from there.

    Others go on to their end; the notes of the subtasks say which do what.
    """

    id: str
    hold: bool = False
    here: bool = False


class ResumeAsk(Signed, frozen=True, kw_only=True):
    """`resume`: takes an operator's pause back; one by a soft stop ends with that."""

    id: str
    here: bool = False


class RetryAsk(Signed, frozen=True, kw_only=True):
    """`retry`: a task that failed or was cancelled, or one subtask of a task that goes on. New attempts are fenced."""

    id: str
    subtask: str = ""
    here: bool = False


class CancelTaskAsk(Signed, frozen=True, kw_only=True):
    """`cancel`, `cancel_here`: which task."""

    id: str


class AnswerAsk(Signed, frozen=True, kw_only=True):
    """`answer`: to the question of that id."""

    id: str
    answer: Annotated[str, Meta(max_length=MAX_ANSWER)]


class EnquiriesAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`enquiries`: of the fleet, or (`local`) those whose records the asked gateway owns."""

    local: bool = False


class EnquiryList(Struct, frozen=True, kw_only=True):
    """Open questions, oldest first; `unreachable` names gateways that did not answer in time."""

    enquiries: tuple[Enquiry, ...]
    unreachable: tuple[str, ...] = ()


class ActsAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`acts`: how many at most, newest first."""

    limit: int = 100


class ActList(Struct, frozen=True, kw_only=True):
    """Orders of operators, newest first."""

    acts: tuple[Act, ...]
