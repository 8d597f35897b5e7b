"""What makes one order wait for another: conditions, and orders told in another sequence than they happen.

"While A, B", "before A, B", "once A, B", "A after B", "A first", "if A, B": each comes down to clauses added in the
order in which they happen, and edges between them. The base of the parser, which reads sentences and clauses.
"""

import re
from abc import ABC, abstractmethod

from appliance.llm.rules import lexicon as lx
from appliance.llm.rules import names
from appliance.llm.rules.clauses import Clause, Reader, Who
from appliance.llm.rules.graph import Graph, Snapshot
from appliance.llm.rules.phrases import Step
from appliance.llm.rules.wording import DONE, HERE, LEAD_FIRST, clean, first_chunk
from appliance.model import RobotInfo, Site
from appliance.skills.catalogue import Catalogue


class Conditions(ABC):
    """State of reading one instruction, and the conditions in it."""

    def __init__(self, catalogue: Catalogue, *, robots: tuple[RobotInfo, ...] | None, site: Site | None) -> None:
        roster = None if robots is None else tuple(robot.id for robot in robots)
        self._names = names.Names(roster, tuple(robot.id for robot in robots or () if robot.flies))
        self._quotes: list[str] = []
        self._site = site
        self._reader = Reader(catalogue, self._names, self._known_place, self._quotes)
        self._graph = Graph(catalogue)
        self._said = 0
        self._lost: float = 0.0
        self._pieces: list[str] = []
        self._to: list[str] = ["any"]
        """Whom an elided subject means."""
        self._anys = 0
        self._last: Clause | None = None
        self._whole: Clause | None = None
        """The last clause that was read while splitting a sentence."""
        self._all_beside = False
        """The sentence said in advance that all of it runs together."""
        self._source = ""
        """A file that was put before what is done with it."""

    def _known_place(self, name: str) -> bool:
        return self._site is not None and self._site.find(name) is not None

    def _prefixed(self, word: str, rest: str, start: Snapshot | None) -> bool:
        """Read "while A, B", "before A, B", "once A, B"; False when no comma separates two clauses."""
        word = word.removeprefix("only ")
        for match in re.finditer(r"\s*[,:]\s*(?:then\s+)?", rest):
            condition, main = rest[: match.start()], rest[match.end() :]
            vocative = self._names.leading(main)
            if not (
                self._reader.starts(first_chunk(main))
                or vocative
                or LEAD_FIRST.match(main)
                or re.match(r"at |in ", main)
            ):
                continue
            if word in ("while", "whilst", "as"):
                before = self._graph.snapshot() if start is None else start
                self._clauses(condition, start)
                self._graph.scope = set()
                self._clauses(self._spoken_to(main), before)
            elif word == "before":
                old = len(self._graph.steps)
                self._clauses(self._spoken_to(main), start)
                self._graph.barrier |= self._graph.lasts(range(old, len(self._graph.steps)))
                self._clauses(condition, None)
            else:
                self._condition(word, condition)
                self._clauses(self._spoken_to(main), None)
            return True
        return False

    def _condition(self, word: str, text: str) -> None:
        """Make what follows in this sentence wait for a condition: work that is done, or an event."""
        graph = self._graph
        if graph.steps and HERE.fullmatch(text):
            graph.barrier |= graph.lasts()
            return
        done = DONE.fullmatch(text)
        if graph.steps and done:
            robot = self._names.known(done["who"]) or (
                self._names.resolve(done["who"]) if self._names.resolve(done["who"]) in graph.tails else None
            )
            graph.barrier |= graph.tails[robot] if robot in graph.tails else graph.lasts()
            return
        old = len(graph.steps)
        if self._reader.starts(first_chunk(text)) and word != "if":
            self._clauses(text, None)
            if len(graph.steps) > old:
                graph.barrier |= graph.lasts(range(old, len(graph.steps)))
                return
        checked = any(graph.catalogue.skills[skill].observes for skill, _, _ in graph.steps)
        if word in ("if", "in case"):
            graph.barrier |= graph.lasts()
            if not checked:
                self._lose(f"{word} {text}", len(text.split()) + 1)
        elif (
            graph.steps
            and checked
            and re.match(r"(?:you|it|he|she|they|everyone|everybody|all|both)\b", text, re.IGNORECASE)
        ):
            graph.barrier |= graph.lasts()
        else:
            step = Step("wait_for", {"event": self._reader.unquote(text.strip(" ,."))})
            _, ends = graph.add(self._to[:1] if self._to != ["all"] else ["any"], [step])
            graph.barrier |= ends

    def _afterwards(self, kind: str, said: str, clause: Clause, before: str, start: Snapshot | None) -> set[int] | None:
        """Read "A after B" in the order in which it happens; None when B is no clause.

        B is told with A's words ("places the box after fetching it"), so A is remembered first, then B is added.
        """
        speaking_to, last = self._to, self._last
        self._to = self._doers(clause.who)
        self._remember(clause)
        if (first := self._reader.read(before, speaking_to=self._to)) is None:
            self._to, self._last = speaking_to, last
            return None
        doers = self._to
        _, ends = self._emit(kind, first, start)
        self._to = doers
        clause = self._reader.read(said, speaking_to=doers) or clause
        self._lost += first.lost + clause.lost
        firsts, _ = self._emit("list", clause, None)
        self._graph.order(ends, firsts)
        return firsts

    def _earlier(self, text: str) -> None:
        """Read "Close the clamp first", said after what it comes before."""
        graph = self._graph
        clause = self._reader.read(re.sub(r"\s+first[.!]?$", "", text), speaking_to=self._to)
        if clause is None:
            self._lose(text, len(text.split()))
            return
        self._lost += clause.lost
        later = {node for node in range(len(graph.steps)) if not graph.before[node]}
        tails = dict(graph.tails)
        _, ends = graph.add(list(self._doers(clause.who)), clause.steps, beside=Snapshot({}, frozenset(), frozenset()))
        graph.order(ends, later)
        graph.tails = {**graph.tails, **tails}

    def _halves(self, text: str) -> tuple[str, str] | None:
        """Split "you find him, notify the guard" (the comma may be missing) into condition and order."""
        for match in re.finditer(r",\s*", text):
            if self._reader.starts(first_chunk(text[match.end() :])):
                return text[: match.start()], text[match.end() :]
        for match in re.finditer(r"\s+(?=([a-z]+)\b)", text):
            condition = text[: match.start()]
            if match[1] in lx.LEMMA and lx.LEMMA[match[1]] == match[1] and len(condition.split()) > 1:
                about = DONE.fullmatch(condition) or self._reader.starts(condition)
                if about and self._reader.starts(first_chunk(text[match.end() :])):
                    return condition, text[match.end() :]
        return None

    def _late_condition(self, kind: str, text: str, firsts: set[int], sentence: Snapshot) -> None:
        """Read "A once B", said in that order: B comes first."""
        graph = self._graph
        old = len(graph.steps)
        if DONE.fullmatch(clean(text)) and len(graph.steps) > len(firsts):
            graph.order(graph.lasts(set(range(old)) - firsts), firsts)
            return
        tails, thread = dict(graph.tails), graph.thread
        graph.tails, graph.thread, graph.barrier = dict(sentence.tails), sentence.thread, sentence.barrier
        graph.scope = set()
        if self._reader.starts(first_chunk(text)):
            self._clauses(text, None)
            graph.order(graph.lasts(range(old, len(graph.steps))), firsts)
            graph.tails, graph.thread = {**graph.tails, **tails}, thread
            return
        if kind == "when":
            step = Step("wait_for", {"event": self._reader.unquote(clean(text))})
            robots = self._to[:1] if self._to != ["all"] else ["any"]
            _, ends = graph.add(robots, [step], beside=Snapshot(dict(sentence.tails), frozenset(), graph.barrier))
            graph.order(ends, firsts)
            graph.tails, graph.thread = {**graph.tails, **tails}, thread
            return
        graph.tails, graph.thread = tails, thread
        self._lose(text, len(text.split()))

    @abstractmethod
    def _clauses(self, text: str, start: Snapshot | None) -> None:
        """Read clauses and what stands between them."""

    @abstractmethod
    def _emit(self, kind: str, clause: Clause, beside: Snapshot | None) -> tuple[set[int], set[int]]:
        """Add a clause to the graph; return its first and last subtasks."""

    @abstractmethod
    def _spoken_to(self, text: str) -> str:
        """Take the names off the front of a text; they are spoken to from then on."""

    @abstractmethod
    def _doers(self, who: Who) -> list[str]:
        """Return the robots that a subject means."""

    @abstractmethod
    def _remember(self, clause: Clause) -> None:
        """Keep what was mentioned, for pronouns."""

    @abstractmethod
    def _lose(self, piece: str, words: int) -> None:
        """Count words that were not understood."""
