"""The form of the grammar: steps, patterns, and what patterns may ask about the conversation.

A pattern is matched against "base-form rest" of one clause, quantities already taken out. Patterns of one verb are
tried in order, the most specific first. What a step's parameters hold is still text of the instruction; pronouns
are resolved by the `Scope`, since only it knows what was mentioned before.
"""

import re
from collections.abc import Callable
from typing import Any, Protocol

from msgspec import Struct, field

from appliance.llm.rules import lexicon as lx


class Step(Struct):
    """One thing to do. `at`: where the robot must be for it. `fetch`: pick `object` first unless it is held."""

    skill: str
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    at: str = ""
    fetch: bool = False


class Scope(Protocol):
    """What the patterns ask about the conversation so far."""

    def thing(self, text: str) -> str:
        """Resolve an object, pronouns included."""
        ...

    def cargo(self, text: str) -> str:
        """Resolve what is put down or handed over, "it" being the thing held."""
        ...

    def place(self, text: str) -> str:
        """Resolve a place; "there" is the last one."""
        ...

    def person(self, text: str) -> str:
        """Resolve somebody; "me" and "us" are the operator."""
        ...

    def robot(self, text: str) -> str | None:
        """Return the robot a text names, or None."""
        ...

    def is_person(self, text: str) -> bool:
        """Whether a text names a person rather than a place."""
        ...

    def known_place(self, text: str) -> bool:
        """Whether the site knows a place of that name."""
        ...

    def group(self, text: str) -> list[str]:
        """Return the robots a text names; "themselves", "" and the like are those spoken to."""
        ...

    def model(self) -> str:
        """Return the model last spoken of."""
        ...


Match = re.Match[str]
Maker = Callable[[Match, Scope], list[Step] | None]

LOCATION = r"(?: (?:at|in|inside) (?P<loc>(?!order\b|parallel\b).+?))?"
"""Where it is done, said after the object."""
ARTICLE = r"(?:(?:the|a|an|its|his|her|their|your|my|our|any|some|one) )?"
PICTURES = r"(?:photos?|photographs?|pictures?|stills?|snapshots?|images?|shots?|snaps?)"
ROUTES = r"(?:routes?|paths?|trails?|tracks?|waypoints?|trajector(?:y|ies)|way)"


class Patterns:
    """The patterns of one part of the grammar, by verb."""

    def __init__(self) -> None:
        self._table: dict[str, list[tuple[re.Pattern[str], Maker]]] = {}

    def on(self, lemmas: str, tail: str) -> Callable[[Maker], Maker]:
        """Register a maker for these verbs followed by `tail`, a regular expression up to the end of the clause."""

        def register(maker: Maker) -> Maker:
            for lemma in lemmas.split():
                pattern = re.compile(f"{lemma}{tail}", re.IGNORECASE | re.DOTALL)
                self._table.setdefault(lemma, []).append((pattern, maker))
            return maker

        return register

    def fixed(self, lemmas: str, tail: str, skill: str) -> None:
        """Register verbs that mean a skill without parameters."""

        def maker(match: Match, scope: Scope) -> list[Step]:
            del match, scope
            return [Step(skill)]

        self.on(lemmas, tail)(maker)

    def simple(self, lemmas: str, tail: str, skill: str, **slots: str) -> None:
        """Register verbs whose slots are one object each (parameter=group); group `loc` is the place to be at.

        Several things in the first slot ("pump 3 and pump 4") are one step each.
        """

        def maker(match: Match, scope: Scope) -> list[Step]:
            groups = match.groupdict()
            at = scope.place(groups["loc"]) if groups.get("loc") else ""
            main = next(iter(slots), "")
            steps: list[Step] = []
            for each in lx.things(groups.get(slots[main]) or "") if main else [""]:
                said = {name: each if name == main else groups.get(slot) for name, slot in slots.items()}
                params = {name: scope.thing(text) for name, text in said.items() if text}
                steps.append(Step(skill, {name: value for name, value in params.items() if value}, at=at))
            return steps

        self.on(lemmas, tail)(maker)

    def match(self, lemma: str, text: str, scope: Scope) -> tuple[list[Step], str] | None:
        """Return the steps of a verb phrase and the words before its first slot, or None when no pattern fits."""
        for pattern, maker in self._table.get(lemma, ()):
            if match := pattern.fullmatch(text):
                steps = maker(match, scope)
                if steps:
                    starts = [match.start(name) for name, value in match.groupdict().items() if value]
                    return steps, text[: min(starts, default=len(text))].strip()
        return None
