"""Questions to people on fakes: one answer, kept over attempts, and an end when nobody answers."""

import asyncio
from typing import Any, cast

import pytest

from appliance.errors import ConflictError, DeadlineError, NotFoundError, PayloadError, RefusedError, UnreachableError
from appliance.model import Enquiry, encode, keyspace
from appliance.model.task_api import AnswerAsk, EnquiriesAsk
from appliance.tasks import enquiries as module
from appliance.tasks.audit import Audit
from appliance.tasks.enquiries import Enquiries, enquiry_of, stronger

pytestmark = pytest.mark.anyio


@pytest.fixture
def asking(plane: Any) -> Enquiries:
    """Return the questions of a gateway in memory."""
    it = Enquiries(plane)
    it.start(Audit(plane.session, plane.keys, "gw-1"))
    return it


def question(**fields: Any) -> Enquiry:
    """Return a question of task t."""
    usual = {"question": "May I?", "choices": ["yes", "no"], "to": "operator", "expires_s": 5.0}
    return enquiry_of("t/s1/1", **(usual | fields))


async def asked(it: Enquiries, enquiry: Enquiry) -> tuple["asyncio.Task[Enquiry]", list[str]]:
    """Ask, and wait until it is in the list."""
    notes: list[str] = []
    task = asyncio.create_task(it.ask(enquiry, on_wait=notes.append))
    async with asyncio.timeout(60):
        while not (await it.enquiries(EnquiriesAsk(local=True))).enquiries:
            await asyncio.sleep(0.005)
    return task, notes


async def test_the_first_answer_wins_and_the_handler_gets_it(asking: Enquiries, plane: Any) -> None:
    """Who comes second hears who was first; the same answer given twice, since its answer was lost, is one."""
    task, notes = await asked(asking, question())
    with pytest.raises(PayloadError, match="none of the answers"):
        await asking.answer(AnswerAsk(id="t:s1:1", answer="maybe", by="ann"))
    answered = await asking.answer(AnswerAsk(id="t:s1:1", answer="YES", by="ann"))
    assert (answered.answer, answered.by) == ("yes", "ann")
    assert (await asyncio.wait_for(task, 60)).answer == "yes"
    with pytest.raises(ConflictError, match="ann has answered 'yes'"):
        await asking.answer(AnswerAsk(id="t:s1:1", answer="no", by="bob"))
    assert (await asking.answer(AnswerAsk(id="t:s1:1", answer="yes", by="ann"))).answer == "yes"
    assert notes == ["waits for an answer: May I?"]
    assert (await asking.enquiries(EnquiriesAsk(local=True))).enquiries == ()
    told = plane.session.sent(plane.keys(keyspace.ENQUIRY, "t:s1:1"), Enquiry)
    assert [each.answer for each in told] == [None, "yes"]


async def test_a_repeated_attempt_gets_the_answer_that_was_given_meanwhile(asking: Enquiries) -> None:
    """The gateway that asked has died: the next attempt asks the same effect, and has its answer at once."""
    task, _ = await asked(asking, question())
    await asking.answer(AnswerAsk(id="t:s1:1", answer="no", by="ann"))
    await task
    again = await asyncio.wait_for(asking.ask(question(), on_wait=lambda _: None), 60)
    assert again.answer == "no"


async def test_nobody_answers(asking: Enquiries) -> None:
    """It ends with the question, is not listed any more, and a late answer is refused; asked again it is open again."""
    with pytest.raises(DeadlineError, match="May I"):
        await asking.ask(question(expires_s=0.01), on_wait=lambda _: None)
    with pytest.raises(RefusedError, match="expired"):
        await asking.answer(AnswerAsk(id="t:s1:1", answer="yes", by="ann"))
    task, _ = await asked(asking, question())
    await asking.answer(AnswerAsk(id="t:s1:1", answer="yes", by="ann"))
    assert (await asyncio.wait_for(task, 60)).answer == "yes"


async def test_a_cancelled_run_withdraws_its_question(asking: Enquiries) -> None:
    """Nobody is asked for what is not wanted any more."""
    task, _ = await asked(asking, question())
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    async with asyncio.timeout(60):
        while (await asking.enquiries(EnquiriesAsk(local=True))).enquiries:
            await asyncio.sleep(0.005)
    with pytest.raises(RefusedError, match="withdrawn"):
        await asking.answer(AnswerAsk(id="t:s1:1", answer="yes", by="ann"))


async def test_a_put_that_was_missed_is_made_up_for(
    asking: Enquiries, plane: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The record is looked at now and then."""
    monkeypatch.setattr(module, "LOOK_S", 0.02)
    task, _ = await asked(asking, question())
    plane.session.subscribers.clear()
    await asking.answer(AnswerAsk(id="t:s1:1", answer="yes", by="ann"))
    assert (await asyncio.wait_for(task, 60)).answer == "yes"


async def test_what_is_no_question_is_refused(asking: Enquiries) -> None:
    """Without words, with choices that are no list, and an id that there is not."""
    with pytest.raises(PayloadError, match="needs a question"):
        question(question=" ")
    with pytest.raises(PayloadError, match="choices"):
        question(choices="yes")
    with pytest.raises(NotFoundError, match="no question 'x:y:1'"):
        await asking.answer(AnswerAsk(id="x:y:1", answer="yes"))


def test_an_answer_outlives_a_partition() -> None:
    """Of two versions the answered one stands, whichever side is asked."""
    open_one = question()
    closed = cast("Enquiry", type(open_one)(**{**_fields(open_one), "answer": "yes", "by": "ann"}))
    assert stronger(encode(open_one), encode(closed)) == stronger(encode(closed), encode(open_one)) == encode(closed)


def _fields(enquiry: Enquiry) -> dict[str, Any]:
    return {name: getattr(enquiry, name) for name in enquiry.__struct_fields__}


async def test_a_question_waits_on_while_its_record_cannot_be_read(
    asking: Enquiries, plane: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The record's owner is silent for a while: the handler goes on waiting, and gets the answer given later."""
    monkeypatch.setattr(module, "LOOK_S", 0.01)
    task, _ = await asked(asking, question(expires_s=300.0))
    silent, read = asyncio.Event(), plane.dht.read

    async def away(key: str) -> Any:
        silent.set()
        raise UnreachableError("gw-2 may have it and did not answer")

    monkeypatch.setattr(plane.dht, "read", away)
    await asyncio.wait_for(silent.wait(), 60)
    monkeypatch.setattr(plane.dht, "read", read)
    await asking.answer(AnswerAsk(id="t:s1:1", answer="yes", by="ann"))
    assert (await asyncio.wait_for(task, 60)).answer == "yes"
