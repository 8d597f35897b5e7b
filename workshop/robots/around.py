"""What the simulated robot does with what is around it: doors, devices, people. It has an arm, a voice and ears."""

from collections.abc import Awaitable, Callable

from appliance.model import Pose
from appliance.robots.executor import Done, Verb
from appliance.robots.verbs import AskArgs, GiveArgs, NamedArgs, RobotFailure, SayArgs
from workshop.robots.world import CLOSED, HEARING_M, OFF, ON, OPEN, Thing, World, answer

TURN_S = 2.0
"""What the arm needs for a door or a switch, simulated seconds."""
WORDS_PER_S = 3.0
MAX_WORDS = 2000
"""Characters said at once."""


class Around:
    """Of one robot.

    Args:
        robot: its name.
        world: as it knows it.
        pose: tells where it is.
        wait: lets simulated seconds pass.
        announce: tells the others of a change.
    """

    def __init__(
        self,
        robot: str,
        world: World,
        *,
        pose: Callable[[], Pose],
        wait: Callable[[float], Awaitable[None]],
        announce: Callable[[Thing], None],
    ) -> None:
        self._robot = robot
        self._world = world
        self._pose = pose
        self._wait = wait
        self._announce = announce

    def verbs(self) -> dict[str, Verb]:
        """Return the verbs by name."""
        return {
            "open": Verb(run=self._switching(OPEN, (OPEN, CLOSED)), uses=("arm",), resumable=True),
            "close": Verb(run=self._switching(CLOSED, (OPEN, CLOSED)), uses=("arm",), resumable=True),
            "switch_on": Verb(run=self._switching(ON, (ON, OFF)), uses=("arm",), resumable=True),
            "switch_off": Verb(run=self._switching(OFF, (ON, OFF)), uses=("arm",), resumable=True),
            "give": Verb(run=self.give, uses=("arm",)),
            "say": Verb(run=self.say, uses=("speaker",)),
            "ask": Verb(run=self.ask, uses=("speaker", "microphone")),
        }

    def _switching(self, state: str, states: tuple[str, str]) -> Callable[[NamedArgs], Awaitable[Done]]:
        async def run(args: NamedArgs) -> Done:
            thing = self._world.check_switch(args.object, self._pose(), states=states)
            if thing.state == state:
                return Done({"object": thing.name, "state": state, "changed": False})
            await self._wait(TURN_S)
            # Looked at again: it may have driven on, or another robot may have been there.
            thing = self._world.check_switch(args.object, self._pose(), states=states)
            self._announce(self._world.switch(self._robot, thing, state))
            return Done({"object": thing.name, "state": state, "changed": True})

        return run

    async def give(self, args: GiveArgs) -> Done:
        """Hand over what it holds."""
        self._world.check_give(self._robot, args.object, args.to, self._pose())
        await self._wait(TURN_S)
        thing, person = self._world.check_give(self._robot, args.object, args.to, self._pose())
        self._announce(self._world.give(self._robot, thing, person))
        return Done({"object": thing.name, "to": person.name})

    async def say(self, args: SayArgs) -> Done:
        """Say something; who is near enough hears it."""
        words = _spoken(args.text)
        await self._wait(len(words.split()) / WORDS_PER_S)
        return Done({"said": words, "heard_by": self._hearers()})

    async def ask(self, args: AskArgs) -> Done:
        """Ask somebody, and wait for what they say."""
        question = _spoken(args.question)
        person = self._world.person(args.to, self._pose())
        await self._wait(len(question.split()) / WORDS_PER_S + person.delay_s)
        said = answer(person, question)
        if not said:
            raise RobotFailure("robot", f"{person.name} has no answer to {question[:80]!r}", remedy="ask somebody else")
        return Done({"question": question, "answer": said, "by": person.name})

    def _hearers(self) -> list[str]:
        """Names of the people within hearing."""
        found: list[str] = []
        for each in self._world.site.people:
            try:
                self._world.person(each.name, self._pose(), within=HEARING_M)
            except RobotFailure:
                continue
            found.append(each.name)
        return found


def _spoken(text: str) -> str:
    words = " ".join(text.split())
    if not 1 <= len(words) <= MAX_WORDS:
        raise RobotFailure("payload", f"{len(words)} characters, 1 to {MAX_WORDS} can be said at once")
    return words
