"""The upstream tier: any server that speaks OpenAI's chat completions, in the building or elsewhere.

Servers differ in what `response_format` they take, so a refused `json_schema` falls back to `json_object`, and that
to none; what worked is remembered. Failures are sorted by what helps: an answer 429 or 5xx, or no connection, is tried
again within bounds; a refused key or an unknown model is not. The key is read for each request, so that a new one
needs no restart, and it is never part of a message or a log line. A server that fails again and again is left alone for
a while (`routing.Breaker`), and none is asked once the day's budget is spent: offline is normal.
"""

import asyncio
import math
import os
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import structlog
from msgspec import Struct, field

from appliance.errors import ConfigError, DeadlineError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.llm.prompt import MAX_ANSWER_BYTES, messages, plan_schema, read_plan
from appliance.llm.routing import Breaker, Budget
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.llm.tier import Proposal
from appliance.model import Plan, Tier, UpstreamStatus
from appliance.skills.catalogue import Catalogue

if TYPE_CHECKING:
    import httpx

log = structlog.get_logger(__name__)

_FORMATS = ("json_schema", "json_object", "none")
_UNSURE = 0.9
"""Confidence in a valid plan from a server that tells no log-probabilities."""
_PAUSE_S = 0.5
_CONNECT_S = 3.0
KEY_VARIABLE = "SWIFTBOT_UPSTREAM_KEY"
CREDENTIAL = "swiftbot-upstream-key"
"""Name of the systemd credential (`LoadCredential=`) that holds the key."""


class _Token(Struct):
    token: str = ""
    logprob: float = 0.0


class _Logprobs(Struct):
    content: list[_Token] | None = None


class _Message(Struct):
    content: str | None = None


class _Choice(Struct):
    message: _Message = field(default_factory=_Message)
    finish_reason: str | None = None
    logprobs: _Logprobs | None = None


class _Usage(Struct):
    prompt_tokens: int = 0
    completion_tokens: int = 0


class _Completion(Struct):
    choices: list[_Choice]
    usage: _Usage | None = None


class UpstreamTier:
    """Plans by a larger model behind an OpenAI-compatible `/chat/completions`."""

    name = Tier.UPSTREAM
    repairs = True

    def __init__(
        self,
        config: LlmConfig,
        catalogue: Catalogue,
        budget: Budget | None = None,
        paid: Callable[[], None] = lambda: None,
    ) -> None:
        """Ask nothing yet.

        Args:
            config: server, key, bounds.
            catalogue: the skills there are.
            budget: what it may cost a day; None: whatever it does.
            paid: told each time that a request was made.
        """
        self._config = config
        self._catalogue = catalogue
        self._budget = budget or Budget(cost=0, requests=0, price_in=0, price_out=0)
        self._paid = paid
        self._breaker = Breaker(open_s=config.upstream_open_s)
        self._client: httpx.AsyncClient | None = None
        self._format = 0
        self._url = config.upstream_url.rstrip("/") + "/chat/completions"

    @property
    def model(self) -> str:
        """Name of the model there."""
        return self._config.upstream_model

    @property
    def status(self) -> UpstreamStatus:
        """How it stands, for GatewayStatus."""
        now, spent = time.monotonic(), self._budget.on(_today())
        return UpstreamStatus(
            state=self._breaker.state(now),
            retry_after_s=self._breaker.retry_after_s(now),
            requests=spent.requests,
            spent=spent.cost,
            budget=self._config.upstream_budget,
        )

    async def start(self) -> None:
        """Nothing is sent before the first instruction."""

    async def close(self) -> None:
        """Close the connections."""
        if self._client is not None:
            await self._client.aclose()
            self._client = None

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Ask the server for a plan.

        Raises:
            UnreachableError: no connection, or the server keeps failing.
            DeadlineError: it does not answer in time.
            ConfigError: it refuses the key, the address or the model.
            PayloadError: its answer is no chat completion.
            PlanError: its answer is no plan.
            RefusedError: the day's budget is spent.
        """
        if why := self._budget.refuses(_today()):
            raise RefusedError(f"the upstream budget is used up: {why}", remedy="a new budget begins tomorrow")
        now = time.monotonic()
        if not self._breaker.take(now):
            raise UnreachableError(
                f"the upstream server failed several times: left alone for {self._breaker.retry_after_s(now):g} s",
                remedy="check llm.upstream_url and the network",
            )
        chat = messages(context, self._catalogue, previous=previous, problems=problems)
        try:
            answer = await self._ask(chat)
        except SwiftbotError:
            self._breaker.failed(time.monotonic())
            raise
        except asyncio.CancelledError:
            # Mostly the cascade's deadline: a server that never answers in time is as good as none.
            self._breaker.failed(time.monotonic())
            raise
        except BaseException:
            self._breaker.gave_up()
            raise
        self._breaker.succeeded()
        choice = answer.choices[0] if answer.choices else _Choice()
        if choice.finish_reason == "length":
            raise PayloadError(
                "the upstream model's answer was cut off",
                remedy="raise llm.upstream_max_tokens, or give the order in parts",
            )
        plan = read_plan(choice.message.content or "", tier=Tier.UPSTREAM)
        return Proposal(plan=plan, confidence=_confidence(choice.logprobs), model=self._config.upstream_model)

    async def _ask(self, chat: list[dict[str, str]]) -> _Completion:
        tries = 0
        form = self._format
        while True:
            try:
                status, body = await self._post(chat, _FORMATS[form])
            except (UnreachableError, DeadlineError) as error:
                failure: SwiftbotError = error
            else:
                if status == 200:
                    # Remembered only now: a request refused for another reason must not cost the schema for good.
                    self._format = form
                    answer = _decode(body)
                    used = answer.usage or _Usage()
                    self._budget.spend(_today(), tokens_in=used.prompt_tokens, tokens_out=used.completion_tokens)
                    self._paid()
                    return answer
                if status in (400, 422) and form < len(_FORMATS) - 1:
                    log.info("upstream refuses the request", response_format=_FORMATS[form], status=status)
                    form += 1
                    continue
                failure = self._refusal(status, body)
                if status != 429 and status < 500:
                    raise failure
            if tries >= self._config.upstream_retries:
                raise failure
            tries += 1
            await asyncio.sleep(_PAUSE_S * 2 ** (tries - 1))

    async def _post(self, chat: list[dict[str, str]], form: str) -> tuple[int, bytes]:
        import httpx  # noqa: PLC0415 - loading it costs memory that a gateway without upstream keeps

        if self._client is None:
            limit = self._config.upstream_deadline_s
            self._client = httpx.AsyncClient(timeout=httpx.Timeout(limit, connect=min(_CONNECT_S, limit)))
        headers = {"content-type": "application/json", **self._key()}
        content = msgspec.json.encode(self._body(chat, form))
        body = bytearray()
        try:
            async with self._client.stream("POST", self._url, content=content, headers=headers) as response:
                async for part in response.aiter_bytes():
                    body += part
                    if len(body) > 4 * MAX_ANSWER_BYTES:
                        raise PayloadError(
                            f"the upstream server's answer is longer than {4 * MAX_ANSWER_BYTES} bytes",
                            remedy="check that llm.upstream_url is a chat completions server",
                        )
                return response.status_code, bytes(body)
        except httpx.TimeoutException as error:
            raise DeadlineError(
                f"the upstream server {self._url} did not answer in time",
                remedy="raise llm.upstream_deadline_s, or see its load",
            ) from error
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise UnreachableError(
                f"the upstream server {self._url} cannot be reached: {type(error).__name__}: {str(error)[:120]}",
                remedy="check llm.upstream_url and the network",
            ) from error

    def _key(self) -> dict[str, str]:
        where, key = self._found_key()
        if not key.isascii() or not key.isprintable() or " " in key:
            raise ConfigError(f"{where} does not hold a key", remedy="one line, the key alone")
        return {"authorization": f"Bearer {key}"} if key else {}

    def _found_key(self) -> tuple[str, str]:
        """Return where the key comes from, and the key: the file, the service's credential, the environment."""
        file = self._config.upstream_key_file
        where = f"llm.upstream_key_file {file}"
        if not file and (credentials := os.environ.get("CREDENTIALS_DIRECTORY")):
            file = str(Path(credentials) / CREDENTIAL)
            where = f"the credential {CREDENTIAL}"
            if not Path(file).is_file():
                file = ""
        if not file:
            return f"the variable {KEY_VARIABLE}", os.environ.get(KEY_VARIABLE, "").strip()
        try:
            return where, Path(file).read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{where} cannot be read: {error}", remedy="write the key to it") from error

    def _body(self, chat: list[dict[str, str]], form: str) -> dict[str, Any]:
        body: dict[str, Any] = {"model": self._config.upstream_model, "messages": chat, "stream": False}
        if form != "none":
            # Some servers refuse these too; the last resort asks for nothing that can be refused.
            body |= {"temperature": 0, "max_tokens": self._config.upstream_max_tokens}
        if form == "json_schema":
            # Not strict: strict servers take no optional properties, and a plan leaves out what was not said.
            schema = {"name": "plan", "strict": False, "schema": plan_schema(self._catalogue)}
            body |= {"logprobs": True, "response_format": {"type": form, "json_schema": schema}}
        elif form == "json_object":
            body["response_format"] = {"type": form}
        return body

    def _refusal(self, status: int, body: bytes) -> SwiftbotError:
        said = body[:200].decode(errors="replace").strip()
        if status in (401, 403):
            return ConfigError(f"the upstream server refuses the key ({status})", remedy="check llm.upstream_key_file")
        if status == 404:
            return ConfigError(
                f"the upstream server knows no {self._url} or no model {self._config.upstream_model!r}: {said!r}",
                remedy="check llm.upstream_url (it ends in /v1) and llm.upstream_model",
            )
        if status == 429 or status >= 500:
            return UnreachableError(
                f"the upstream server answers {status}: {said!r}", remedy="see its log, try again later"
            )
        return PayloadError(f"the upstream server answers {status}: {said!r}", remedy="see its log")


def _today() -> str:
    return datetime.now().astimezone().date().isoformat()


def _decode(body: bytes) -> _Completion:
    try:
        return msgspec.json.decode(body, type=_Completion)
    except (msgspec.DecodeError, RecursionError) as error:
        raise PayloadError(
            f"the upstream server's answer is no chat completion: {str(error)[:160]}",
            remedy="check that llm.upstream_url is an OpenAI-compatible server",
        ) from error


def _confidence(logprobs: _Logprobs | None) -> float:
    """Return how sure the model was: its mean probability over the tokens that were no foregone conclusion."""
    tokens = [each.logprob for each in (logprobs.content or ())] if logprobs is not None else []
    open_ones = [value for value in tokens if math.isfinite(value) and value < -0.01]
    if not tokens:
        return _UNSURE
    return math.exp(sum(open_ones) / len(open_ones)) if open_ones else 1.0
