"""The upstream tier against real HTTP servers: what works, and every way in which a server can misbehave."""

import asyncio
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from llm_server import ASK, CATALOGUE, PLAN, Answer, Server, ask, completion, config
from msgspec.structs import replace

from appliance.errors import ConfigError, DeadlineError, PayloadError, PlanError, SwiftbotError, UnreachableError
from appliance.llm.cascade import Decomposer
from appliance.llm.settings import PlanContext
from appliance.llm.upstream import UpstreamTier
from appliance.model import RobotInfo, Tier

pytestmark = pytest.mark.anyio

BAD = {
    "domain": "navigation",
    "subtasks": [{"id": "s1", "skill": "dance", "robot": "rover_1", "params": {}, "after": []}],
}


@pytest.fixture
def server() -> Iterator[Server]:
    """Return a running server."""
    running = Server()
    yield running
    running.close()


async def test_plan_from_a_server(server: Server, tmp_path: Path) -> None:
    """A plan comes back; the request holds model, schema, prompt and key as OpenAI's interface has them."""
    key = tmp_path / "key"
    key.write_text("secret-1\n")
    server.answers = [completion(PLAN)]
    proposal = await ask(server, upstream_key_file=str(key))
    assert proposal.plan.tier is Tier.UPSTREAM
    assert proposal.plan.subtasks[0].params == {"place": "dock 1"}
    (body,) = server.asked
    assert server.paths == ["/v1/chat/completions"]
    assert server.keys == ["Bearer secret-1"]
    assert body["model"] == "big"
    assert body["response_format"]["json_schema"]["schema"]["required"] == ["domain", "subtasks"]
    assert body["messages"][0]["role"] == "system"
    assert "Rover_1: go to dock 1" in body["messages"][-1]["content"]


async def test_log_probabilities_become_the_confidence(server: Server) -> None:
    """Where the server tells token probabilities, doubt in some of them lowers the confidence."""
    server.answers = [
        completion(PLAN, logprobs={"content": [{"token": "a", "logprob": -0.0001}, {"token": "b", "logprob": -0.7}]})
    ]
    assert (await ask(server)).confidence == pytest.approx(0.4966, abs=1e-3)


async def test_refused_schema_falls_back_and_is_remembered(server: Server) -> None:
    """A server that refuses json_schema is asked for json_object, then for plain text, and from then on so."""

    def picky(body: dict[str, Any]) -> Answer:
        refused = "response_format" in body
        return (400, b'{"error": {"message": "response_format is not supported"}}') if refused else completion(PLAN)

    server.answers = [picky]
    tier = UpstreamTier(config(server), CATALOGUE)
    try:
        await tier.propose(ASK)
        await tier.propose(ASK)
    finally:
        await tier.close()
    formats = [(body.get("response_format") or {"type": "none"})["type"] for body in server.asked]
    assert formats == ["json_schema", "json_object", "none", "none"]


async def test_refusal_for_another_reason_does_not_cost_the_schema(server: Server) -> None:
    """A request that is refused in every form is an error, and the next one is asked with the schema again."""
    server.answers = [(400, b"context too long")]
    tier = UpstreamTier(config(server), CATALOGUE)
    try:
        with pytest.raises(PayloadError, match="context too long"):
            await tier.propose(ASK)
        server.answers = [completion(PLAN)]
        await tier.propose(ASK)
    finally:
        await tier.close()
    assert server.asked[-1]["response_format"]["type"] == "json_schema"


async def test_failing_server_is_tried_again_within_bounds(server: Server) -> None:
    """One 503 is tried again and forgotten; a server that keeps failing is an UnreachableError that says so."""
    server.answers = [(503, b"warming up"), completion(PLAN)]
    assert (await ask(server)).plan.subtasks
    server.answers = [(500, b"kaputt")]
    with pytest.raises(UnreachableError, match=r"answers 500: 'kaputt'"):
        await ask(server)
    assert len(server.asked) == 2 + 2


@pytest.mark.parametrize(
    ("answer", "kind", "said"),
    [
        ((401, b"{}"), ConfigError, "refuses the key"),
        ((404, b"no such model"), ConfigError, "no such model"),
        ((413, b"too long"), PayloadError, "413"),
        ((200, b"<html>hello</html>"), PayloadError, "no chat completion"),
        ((200, b'{"choices": "none"}'), PayloadError, "no chat completion"),
        ((200, b'{"choices": []}'), PlanError, "holds no plan"),
        ((200, b"[" * 200_000), PayloadError, "no chat completion"),
        ((200, b" " * (2 * 2**20)), PayloadError, "longer than"),
        (completion("I cannot help with that."), PlanError, "holds no plan"),
        (completion('{"domain": "navigation"}'), PlanError, "missing required field"),
        (completion('{"domain": "navi', finish_reason="length"), PayloadError, "cut off"),
    ],
)
async def test_bad_answers_are_named(server: Server, answer: Answer, kind: type[SwiftbotError], said: str) -> None:
    """Each way of answering wrongly is an error of its kind, with the cause, after one request."""
    server.answers = [answer]
    with pytest.raises(kind, match=said):
        await ask(server)
    assert len(server.asked) == 1


async def test_slow_server_is_a_deadline(server: Server) -> None:
    """A server that does not answer is given up after the deadline, without a key in the message."""
    server.answers = [30.0]
    with pytest.raises(DeadlineError, match="did not answer in time"):
        await ask(server, upstream_deadline_s=0.2, upstream_retries=0)


async def test_no_server_is_unreachable(server: Server) -> None:
    """A port where nothing listens is an UnreachableError that names the address."""
    server.close()
    with pytest.raises(UnreachableError, match=server.url):
        await ask(server, upstream_retries=0)


@pytest.mark.parametrize("content", [b"two words", b"\xff\xfe", "schlüssel".encode()])
async def test_bad_key_file(server: Server, tmp_path: Path, content: bytes) -> None:
    """A key file that holds no key is a ConfigError that names the file and not its content."""
    key = tmp_path / "key"
    key.write_bytes(content)
    with pytest.raises(ConfigError, match="key") as caught:
        await ask(server, upstream_key_file=str(key))
    assert "two words" not in str(caught.value)


async def test_invalid_plan_is_repaired_over_http(server: Server) -> None:
    """The cascade asks the same server once more with the validator's words, and takes the mended plan."""
    server.answers = [completion(BAD), completion(PLAN)]
    cascade = Decomposer(config(server, tiers=("upstream",)), CATALOGUE)
    try:
        outcome = await cascade.plan(ASK)
    finally:
        await cascade.close()
    assert outcome.plan.tier is Tier.UPSTREAM
    assert "there is no such skill" in server.asked[1]["messages"][-1]["content"]


async def test_rules_answer_when_the_server_hangs(server: Server) -> None:
    """With a server that hangs, a plain order is still planned, by rules, after the deadline."""
    server.answers = [30.0]
    cascade = Decomposer(config(server, upstream_deadline_s=0.2), CATALOGUE)
    began = time.monotonic()
    try:
        outcome = await cascade.plan(ASK)
    finally:
        await cascade.close()
    assert outcome.plan.tier is Tier.RULES
    assert [attempt.tier for attempt in outcome.attempts] == ["upstream", "rules"]
    assert time.monotonic() - began < 30


# --- cost, offline, keys --------------------------------------------------------------------------------------------
async def test_the_days_budget_is_kept(server: Server) -> None:
    """What an answer cost is counted by its usage and the prices; when the day's budget is spent nothing is sent."""
    paid = {"usage": {"prompt_tokens": 1000, "completion_tokens": 100}}
    status, body = completion(PLAN)
    server.answers = [(status, json.dumps({**json.loads(body), **paid}).encode())]
    prices = {"upstream_price_in": 1.0, "upstream_price_out": 5.0}
    settings = config(server, tiers=("upstream", "rules"), upstream_budget=0.003, cache=0, **prices)
    cascade = Decomposer(replace(settings, require_implemented=False), CATALOGUE)
    try:
        plans = [(await cascade.plan(ASK)).plan for _ in range(3)]
        outcome = await cascade.plan(ASK)
    finally:
        await cascade.close()
    assert [each.tier for each in plans] == [Tier.UPSTREAM, Tier.UPSTREAM, Tier.RULES]
    assert "budget is used up" in outcome.attempts[0].problems[0]
    assert len(server.asked) == 2
    upstream = cascade.status.upstream
    assert upstream is not None
    assert (upstream.requests, upstream.spent, upstream.budget) == (2, 0.003, 0.003)


async def test_a_server_that_is_away_is_left_alone(server: Server) -> None:
    """Offline is normal: after three failures in a row nothing is sent for a while, and the rules answer at once."""
    server.answers = [(503, b"down")]
    settings = config(server, tiers=("upstream", "rules"), upstream_retries=0, require_implemented=False, cache=0)
    cascade = Decomposer(settings, CATALOGUE)
    try:
        outcomes = [await cascade.plan(ASK) for _ in range(6)]
    finally:
        await cascade.close()
    assert all(each.plan.tier is Tier.RULES for each in outcomes)
    assert len(server.asked) == 3
    assert "left alone" in outcomes[-1].attempts[0].problems[0]
    upstream = cascade.status.upstream
    assert upstream is not None
    assert upstream.state == "open"
    assert upstream.retry_after_s > 0


async def test_a_server_that_is_back_is_asked_again(server: Server) -> None:
    """After the pause one question is let through, and its answer closes the breaker."""
    server.answers = [(503, b"down"), (503, b"down"), (503, b"down"), completion(PLAN)]
    settings = config(
        server,
        tiers=("upstream", "rules"),
        upstream_retries=0,
        upstream_open_s=0.05,
        require_implemented=False,
        cache=0,
    )
    cascade = Decomposer(settings, CATALOGUE)
    try:
        for _ in range(3):
            await cascade.plan(ASK)
        while (await cascade.plan(ASK)).plan.tier is not Tier.UPSTREAM:
            await asyncio.sleep(0.02)
    finally:
        await cascade.close()
    upstream = cascade.status.upstream
    assert upstream is not None
    assert upstream.state == "closed"


async def test_where_the_key_comes_from(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file first, then the service's credential, then the environment; without any, none is sent."""
    server.answers = [completion(PLAN)]
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    monkeypatch.delenv("SWIFTBOT_UPSTREAM_KEY", raising=False)
    await ask(server)
    monkeypatch.setenv("SWIFTBOT_UPSTREAM_KEY", "of-environment")
    await ask(server)
    (tmp_path / "swiftbot-upstream-key").write_text("of-service\n")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    await ask(server)
    (tmp_path / "file").write_text("of-file")
    await ask(server, upstream_key_file=str(tmp_path / "file"))
    (tmp_path / "swiftbot-upstream-key").write_text("two words")
    with pytest.raises(ConfigError, match="credential swiftbot-upstream-key does not hold a key"):
        await ask(server)
    assert server.keys == [None, "Bearer of-environment", "Bearer of-service", "Bearer of-file"]


async def test_private_robots_are_not_told_of(server: Server) -> None:
    """A robot whose id matches is in no prompt, and an order that names it goes nowhere."""
    server.answers = [completion(PLAN)]
    settings = config(
        server, tiers=("upstream", "rules"), upstream_never_robots=("nurse_*",), require_implemented=False, cache=0
    )
    uses = tuple(sorted({use for skill in CATALOGUE.skills.values() for use in skill.uses}))
    verbs = tuple(sorted({verb for skill in CATALOGUE.skills.values() for verb in skill.verbs}))
    roster = tuple(RobotInfo(id=each, kind="zenoh", uses=uses, verbs=verbs) for each in ("rover_1", "nurse_1"))
    cascade = Decomposer(settings, CATALOGUE)
    try:
        assert (await cascade.plan(replace(ASK, robots=roster))).plan.tier is Tier.UPSTREAM
        named = PlanContext(instruction="Nurse_1: go to dock 1", robots=roster)
        assert (await cascade.plan(named)).plan.tier is Tier.RULES
    finally:
        await cascade.close()
    assert len(server.asked) == 1
    assert "nurse_1" not in json.dumps(server.asked[0]["messages"][-1])
    upstream = cascade.status.upstream
    assert upstream is not None
    assert upstream.withheld == 1
