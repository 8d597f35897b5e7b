"""The audit of orders: who ordered what of whom, why, and what came of it, on one key and in the log.

What is refused for whom it is from (no good signature, another role, a revoked robot) is in it too. Of each kind ten at
once are told and then one a minute, with how many came between: who sends such things all day hides no order.
"""

import time
import uuid
from collections import OrderedDict, deque
from collections.abc import Awaitable, Callable
from typing import TypeVar, cast

import structlog
from msgspec import Struct

from appliance.errors import SwiftbotError
from appliance.model import Act, Signed, TaskRecord, TaskRequest, keyspace
from appliance.model.keys import Keys
from appliance.model.task_api import ActList, ActsAsk
from appliance.plane.session import Closer, Session
from appliance.tasks.bucket import Bucket
from appliance.tasks.records import clean

log = structlog.get_logger(__name__)

SUBMIT = "submit"

KEPT = 500
"""Orders that a gateway remembers for those who ask, its own and others'; the log on disk has all."""
MAX_PROBLEM = 1000
DENIED, UNVERIFIED = "denied", "unverified"
"""Outcomes: refused for whom it is from; a soft stop that was carried out without a good signature."""
UNPROVEN = "unproven"
"""Who it was that no certificate names."""
DENIED_AT_ONCE = 10
MOST_KINDS = 256
"""Kinds and senders of what is refused that are told apart."""
OF_GATEWAY = frozenset(
    {"drain", "undrain", "pool_warm", "pool_evict", "pool_release_quarantine", "llm_swap", "image_fetch"}
)
"""Verbs that change something of the gateway itself."""
_TARGETS = ("id", "task", "robot", "robots", "container", "image", "folder", "reference")

Q = TypeVar("Q", bound=Signed)
R = TypeVar("R", bound=Struct)
Submit = Callable[[TaskRequest], Awaitable[TaskRecord]]


class Audit:
    """One per gateway. `signed` puts an audit around what answers an operator's verb."""

    def __init__(self, session: Session, keys: Keys, gateway: str) -> None:
        self._session = session
        self._keys = keys
        self._gateway = gateway
        self._acts: deque[tuple[float, Act]] = deque(maxlen=KEPT)
        self._submissions: deque[tuple[float, Act]] = deque(maxlen=KEPT)
        """Apart, so that a script that submits all day does not push out who stopped what."""
        self._denied: deque[tuple[float, Act]] = deque(maxlen=KEPT // 5)
        self._sparing: OrderedDict[tuple[str, str], _Sparing] = OrderedDict()

    def listen(self) -> Closer:
        """Note what is refused here, and remember what others noted: a gateway that dies takes no order along."""
        self._session.watch_denied(self._on_denied)
        return self._session.subscribe_typed(keyspace.ACT, self._on_act)

    def _on_act(self, key: str, act: Act | None) -> None:
        if act is not None and act.gateway != self._gateway and key.endswith(f"/{act.gateway}"):
            self._keep(act)

    def _keep(self, act: Act) -> None:
        denied = self._denied if act.outcome in (DENIED, UNVERIFIED) else self._acts
        (self._submissions if act.verb == SUBMIT and denied is self._acts else denied).append((time.monotonic(), act))

    def _on_denied(self, what: str, key: str, reason: str, by: str) -> None:
        sparing = self._sparing.setdefault((what, by), _Sparing())
        self._sparing.move_to_end((what, by))
        if len(self._sparing) > MOST_KINDS:
            self._sparing.popitem(last=False)
        if not sparing.bucket.take(time.monotonic()):
            sparing.left_out += 1
            return
        between, sparing.left_out = sparing.left_out, 0
        act = Act(
            id=f"o-{uuid.uuid4().hex[:16]}",
            verb=clean(key.rpartition("/")[2], 60),
            by=clean(by, 120) or UNPROVEN,
            target=clean(key.removeprefix(f"{self._keys.root}/"), 300),
            outcome=UNVERIFIED if what.startswith(UNVERIFIED) else DENIED,
            problem=clean(f"{what}: {reason}" + (f" ({between:,} more before)" if between else ""), MAX_PROBLEM),
            gateway=self._gateway,
            at_ns=time.time_ns(),
        )
        self._keep(act)
        self._session.publish(keyspace.ACT, act, self._gateway)

    def signed(
        self, verb: str, handler: Callable[[Q], Awaitable[R]], *, when: Callable[[Q], bool] = lambda _: True
    ) -> Callable[[Q], Awaitable[R]]:
        """Return the handler with an audit around it; what gateways hand on to each other (`here`) has none.

        Args:
            verb: as it is registered.
            handler: what answers.
            when: whether a request is an operator's at all.
        """

        async def answer(ask: Q) -> R:
            if getattr(ask, "here", False) or not when(ask):
                return await handler(ask)
            return await self._noted(verb, ask, handler)

        return answer

    def submission(
        self, handler: Callable[[TaskRequest], Awaitable[TaskRecord]]
    ) -> Callable[[TaskRequest], Awaitable[TaskRecord]]:
        """Return the handler of `submit` with an audit around it: who wants it stands in the request itself."""

        async def answer(request: TaskRequest) -> TaskRecord:
            target = request.id or "a new task"
            return await self._noted(SUBMIT, Signed(by=request.submitter), lambda _: handler(request), target)

        return answer

    async def _noted(self, verb: str, ask: Q, handler: Callable[[Q], Awaitable[R]], target: str = "") -> R:
        began = time.monotonic()
        try:
            reply = await handler(ask)
        except SwiftbotError as error:
            self._note(verb, ask, began, error.code, error.message, target)
            raise
        except Exception as error:
            self._note(verb, ask, began, "internal", f"{type(error).__name__}: {error}", target)
            raise
        self._note(verb, ask, began, "done", "", target)
        return reply

    def _note(self, verb: str, ask: Signed, began: float, outcome: str, problem: str, target: str) -> None:
        act = Act(
            id=ask.act or f"o-{uuid.uuid4().hex[:16]}",
            verb=verb,
            by=clean(ask.by, 120) or "unsigned",
            target=clean(target, 300) or self._target(verb, ask),
            why=clean(ask.why, 500),
            outcome=outcome,
            problem=clean(problem, MAX_PROBLEM),
            gateway=self._gateway,
            at_ns=time.time_ns(),
            took_ms=round((time.monotonic() - began) * 1e3, 2),
        )
        self._keep(act)
        self._session.publish(keyspace.ACT, act, self._gateway)
        log.info(
            "operator's order",
            verb=verb,
            by=act.by,
            target=act.target,
            why=act.why,
            outcome=outcome,
            problem=act.problem,
            act=act.id,
        )

    def _target(self, verb: str, ask: Signed) -> str:
        """Return what an order is about; one to a gateway for itself names that gateway."""
        target = target_of(ask)
        if verb not in OF_GATEWAY:
            return target
        return f"{target} on {self._gateway}" if target else self._gateway

    async def acts(self, ask: ActsAsk) -> ActList:
        """Answer `acts`."""
        # By when they were heard of here: clocks of gateways differ.
        newest = sorted((*self._acts, *self._submissions, *self._denied), key=lambda heard: heard[0], reverse=True)
        return ActList(acts=tuple(act for _, act in newest[: max(0, ask.limit)]))


class _Sparing:
    """How much of one kind of refusal is told."""

    def __init__(self) -> None:
        self.bucket = Bucket(1 / 60, burst=DENIED_AT_ONCE)
        self.left_out = 0


def target_of(ask: Signed) -> str:
    """What an order is about, by the fields that such requests have."""
    found: list[str] = []
    for name in _TARGETS:
        value: object = getattr(ask, name, "")
        if isinstance(value, tuple):
            found.append(", ".join(cast("tuple[str, ...]", value)) or "the fleet")
        elif value:
            found.append(str(value))
    subtask = str(getattr(ask, "subtask", "") or "")
    return clean("/".join([*found, *([subtask] if subtask else [])]), 300)
