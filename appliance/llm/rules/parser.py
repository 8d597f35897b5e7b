"""Instruction to graph: sentences, the clauses in them, and what the words between them mean for the order.

Goes through the text once, left to right. Each word of it is either understood (part of a clause that fits a
pattern, or a connective) or not; the share that was understood is the confidence. Nothing is guessed: a clause that
fits no pattern adds no subtask and costs confidence.
"""

import re
from typing import Any

from msgspec import Struct

from appliance.llm.rules import lexicon as lx
from appliance.llm.rules import names
from appliance.llm.rules.clauses import Clause, Who
from appliance.llm.rules.conditions import Conditions
from appliance.llm.rules.graph import Snapshot
from appliance.llm.rules.phrases import Step
from appliance.llm.rules.wording import (
    BETWEEN,
    DONE,
    FILE,
    HEADING,
    LEAD_ALL,
    LEAD_BESIDE,
    LEAD_FIRST,
    PREFIX,
    TRAILING,
    clean,
    first_chunk,
    renamed,
    sentences,
)
from appliance.model import Subtask


class Reading(Struct):
    """What became of an instruction: the subtasks and how much of it was understood."""

    subtasks: tuple[Subtask, ...]
    confidence: float
    lost: tuple[str, ...]
    """Pieces that fit no pattern."""


class Parser(Conditions):
    """Reads one instruction."""

    def parse(self, instruction: str) -> Reading:
        """Read the whole instruction."""
        for sentence in sentences(instruction, self._quotes, self._names.sure.pattern):
            self._sentence(sentence)
        subtasks = self._graph.subtasks()
        labels = {each.robot for each in subtasks} | {
            name for each in subtasks for name in each.params.get("robots", ())
        }
        if "any1" in labels and "any2" not in labels:
            subtasks = tuple(renamed(each, "any1", "any") for each in subtasks)
        elif "any2" in labels and not labels & {"any", "any1"}:
            subtasks = tuple(renamed(each, "any2", "any") for each in subtasks)
        elif "any2" in labels and "any" in labels:
            subtasks = tuple(renamed(each, "any", "any1") for each in subtasks)
        confidence = max(0.0, 1.0 - self._lost / self._said) if self._said and subtasks else 0.0
        return Reading(subtasks, round(confidence, 3), tuple(self._pieces[:8]))

    # --- one sentence ---------------------------------------------------------------------------------------------

    def _sentence(self, text: str) -> None:
        words = len(text.split())
        self._said += words
        beside = False
        wait_all = False
        for _ in range(3):
            if match := LEAD_ALL.match(text):
                wait_all, text = True, text[match.end() :]
            elif match := LEAD_BESIDE.match(text):
                beside, text = True, text[match.end() :]
            elif match := LEAD_FIRST.match(text):
                text = text[match.end() :]
        if not text.strip(" ,.:"):
            return
        start = self._graph.new_sentence(parallel=beside)
        if wait_all:
            self._graph.barrier |= self._graph.lasts()
            self._graph.sentence.barrier = self._graph.barrier
        self._all_beside = beside and not self._graph.steps
        self._last = None
        text = self._spoken_to(text)
        if not text.strip(" ,.:"):
            return
        if (match := FILE.fullmatch(text)) and self._reader.starts(first_chunk(match["rest"])):
            self._source, text = match["file"], match["rest"]
        elif (
            (match := HEADING.fullmatch(text))
            and not PREFIX.match(text)
            and not self._reader.starts(text)
            and match["rest"]
        ):
            self._lost += len(match["head"].split())
            text = self._spoken_to(match["rest"])
        if re.search(r"\w first[.!]?$", text) and self._graph.steps:
            self._earlier(text)
            return
        text = self._trailing(text)
        if (match := PREFIX.fullmatch(text)) and self._prefixed(match["word"].lower(), match["rest"], start):
            return
        if self._leading_place(text, start):
            return
        self._clauses(text, start)

    def _spoken_to(self, text: str) -> str:
        """Take "Robot_1:", "A and B," off the front; they are spoken to until somebody else is."""
        match = re.match(r"(?:mission|task|plan|orders|list|job) for (?P<rest>.+)", text, re.IGNORECASE | re.DOTALL)
        body = match["rest"] if match else text
        if match := re.match(
            r"(?P<n>[A-Z][\w-]*(?: (?:\d+|[A-Z]))?)'s (?:list|tasks?|jobs?|orders)[^:]*:\s*(?P<rest>.+)",
            body,
            re.DOTALL,
        ):
            self._address([self._names.resolve(match["n"])])
            return match["rest"]
        if match := names.ALL.match(body) or names.SEVERAL.match(body):
            rest = body[match.end() :]
            if mark := re.match(r"(?:,? please)?\s*[:,]\s*", rest):
                groups = match.groupdict()
                if groups.get("n"):
                    robots = [f"any{index + 1}" for index in range(int(lx.number(groups["n"]) or 2))]
                else:
                    robots = self._names.everyone(groups.get("kind") or groups.get("plural") or "")
                self._address(robots)
                return rest[mark.end() :]
        found = self._names.leading(body)
        if found:
            robots, rest = found
            mark = re.match(r"\s*(?::|,|\s-)\s*", rest)
            if mark and rest[mark.end() :].strip() and (":" in mark[0] or self._follows(rest[mark.end() :])):
                self._address(list(dict.fromkeys(robots)))
                return re.sub(r"^(?:this is \w+[:,.]?\s*)", "", rest[mark.end() :])
            if mark is None and rest.strip(" .") == "":
                self._address(robots)
                return ""
        return text

    def _follows(self, text: str) -> bool:
        """Whether what stands after a name is said to it: it starts with a verb, or a politeness before one."""
        text = re.sub(r"^(?:this is \w+[:,.]?\s*)", "", text)
        if not text.strip():
            return True
        if (
            PREFIX.match(text)
            or LEAD_FIRST.match(text)
            or re.match(r"(?:at|in) (?!the same)|please|what|i\b|could|can|would", text, re.IGNORECASE)
        ):
            return True
        first = re.match(r"[A-Za-z']+", text)
        return bool(first and first[0].lower() in lx.LEMMA and not re.match(r"\w+(?:es|s)\b", first[0])) or bool(
            first and self._reader.starts(BETWEEN.split(text)[0] or text)
        )

    def _trailing(self, text: str) -> str:
        """Take a name off the end ("Inspect the pump, Heron") or the middle and speak to it."""
        for match in TRAILING.finditer(text):
            name = match["name"]
            sure = self._names.sure.fullmatch(name)
            if not sure and not (
                name[0].isupper() and name.split()[0].lower() not in names.NOT_NAMES and self._names.roster is None
            ):
                continue
            without = text[: match.start()] + text[match.end() :]
            if not sure and not self._reader.starts(text[: match.start()]):
                continue
            if re.search(r",\s*[A-Z]\w*|\b[A-Z]\w* and\b", text[: match.start()]) and not sure:
                continue
            self._address([self._names.resolve(name)])
            return without
        return text

    def _address(self, robots: list[str]) -> None:
        self._names.seen.update(robots)
        self._to = robots
        self._mention(robots)

    def _mention(self, robots: list[str]) -> None:
        mentions = self._reader.mentions
        mentions.robots = list(robots)
        if len(robots) > 1:
            mentions.group = list(robots)
        elif robots and robots[0] not in mentions.group and not robots[0].startswith("any"):
            mentions.group = [*mentions.group[-1:], *robots] if mentions.group else list(robots)

    def _leading_place(self, text: str, start: Snapshot | None) -> bool:
        """Read "at stations 3, 5 and 8, read the barcode": the rest once at each place."""
        match = re.match(
            r"(?:at|in|on|inside) (?P<p>.+?), (?P<rest>(?!and )[^,]*\b.*)", text, re.IGNORECASE | re.DOTALL
        )
        while match and not self._reader.starts(first_chunk(match["rest"])):
            match = re.match(
                rf"(?:at|in|on|inside) (?P<p>{re.escape(match['p'])}, .+?), (?P<rest>(?!and ).+)",
                text,
                re.IGNORECASE | re.DOTALL,
            )
        if match is None or self._reader.starts(match["p"]):
            return False
        if re.match(r"the (?:gateway|server|edge)\b", match["p"], re.IGNORECASE):
            self._clauses(match["rest"], start)
            return True
        for place in lx.things(match["p"]):
            where = self._reader.place(place)
            self._graph.add(self._doers(Who()), [Step("goto", {"place": where})], beside=start)
            self._reader.mentions.place = where
            self._clauses(match["rest"], None)
        return True

    # --- clauses and what stands between them -----------------------------------------------------------------------

    def _chunks(self, text: str) -> list[tuple[str, str]]:
        """Split a sentence into (connective, clause), where both sides of a connective are clauses."""
        found: list[tuple[str, str]] = []
        kind, begin, where = "list", 0, 0
        while match := BETWEEN.search(text, where):
            left, right = text[begin : match.start()], text[match.end() :]
            this = match.lastgroup or "list"
            this = "if" if this == "when" and match[0].split()[-1].lower() == "if" else this
            where = match.end()
            if not left.strip(" ,"):
                kind, begin = (this if this != "list" else kind), match.end()
                continue
            if this == "beside" and not right.strip(" ,."):
                continue
            if self._breaks(this, left, right):
                found.append((kind, left))
                kind, begin = this, match.end()
        found.append((kind, text[begin:]))
        return found

    def _breaks(self, kind: str, left: str, right: str) -> bool:
        head = first_chunk(right)
        clause = self._reader.read(left, speaking_to=self._to) or self._gapped(left, self._whole)
        readable = clause is not None or self._reader.starts(left)
        gapped = self._gapped(head, clause) if clause is not None else None
        gap = gapped is not None
        if clause is not None:
            self._whole = clause
        if kind in ("before", "after", "when", "if"):
            if re.search(r"\b(?:wait|until|till|waits)\b", left) and kind != "before":
                return False
            return readable and (
                self._reader.starts(head) or DONE.fullmatch(clean(right)) is not None or kind in ("when", "if")
            )
        if kind == "beside":
            return readable or self._reader.starts(head)
        if not readable:
            return False
        if self._reader.starts(head) or gap:
            return True
        if kind == "then" and (self._follows(right)):
            return True
        if kind == "list" and re.match(r"(?:once|when|after|before|while|if|as soon as)\b", right, re.IGNORECASE):
            return True
        match = BETWEEN.match(right) or None
        return match is not None and match.lastgroup != "list"

    def _gapped(self, text: str, previous: Clause | None) -> Clause | None:
        """Read "robot 3 pallet 62 at dock 5" after "robot 2 picks up pallet 61 at dock 4"."""
        if previous is None:
            return None
        if (match := re.match(r"(to|of|from|for) ", clean(text), re.IGNORECASE)) and previous.prefix.lower().endswith(
            " " + match[1].lower()
        ):
            clause = self._reader.read(f"{previous.prefix.rsplit(' ', 1)[0]} {clean(text)}", speaking_to=self._to)
            if clause is not None:
                clause.prefix = previous.prefix
            return clause
        if re.match(r"(?:the|an?) .+ (?:from|at|in|on|to|into|onto) ", clean(text), re.IGNORECASE):
            # "fetch the red box from dock 3 and the blue box from dock 1"
            clause = self._reader.read(f"{previous.prefix} {clean(text)}", speaking_to=self._to)
            skills = [step.skill for step in previous.steps]
            if clause and skills[-1] in ("pick", "place") and [step.skill for step in clause.steps] == skills:
                clause.prefix = previous.prefix
                return clause
            return None
        if previous.who.kind not in ("named", "one", "first", "other", "all", "the"):
            return None
        found = self._names.leading(clean(text))
        if found is None or len(found[0]) != 1 or not found[1].strip():
            return None
        rest = found[1].strip()
        if re.match(r"(?:that|those) (?:of|from) ", rest) and (quantity := previous.steps[-1].params.get("quantity")):
            rest = f"{quantity} {rest.split(None, 1)[1]}"
        prefix = previous.prefix
        # "drone_1 flies to mast 1 and drone_2 to mast 2": the preposition is said again.
        shorter = prefix.rsplit(" ", 1)[0]
        again = rest.split(None, 1)[0].lower() == prefix.rsplit(" ", 1)[-1].lower()
        for candidate in (shorter, prefix) if again else (prefix, shorter):
            clause = self._reader.read(f"{candidate} {rest}", speaking_to=found[0])
            if clause and [step.skill for step in clause.steps] == [step.skill for step in previous.steps]:
                clause.who = Who(found[0], "named")
                clause.prefix = prefix
                return clause
        return None

    def _clauses(self, text: str, start: Snapshot | None) -> None:
        sentence = self._graph.snapshot() if start is None else start
        pending: list[set[int]] = []
        chunks = self._chunks(text)
        told = False
        for index, (kind, piece) in enumerate(chunks):
            if told:
                told = False
                continue
            if kind in ("when", "if"):
                if halves := self._halves(piece):
                    self._condition(kind, halves[0])
                    self._clauses(halves[1], None)
                    continue
                if pending:
                    # All that follows belongs to the condition: "report once A has done X and B has done Y".
                    rest = " and ".join(each for _, each in chunks[index:])
                    self._late_condition(kind, rest, pending[-1], sentence)
                return
            if (
                kind == "list"
                and (match := PREFIX.fullmatch(piece.strip()))
                and self._prefixed(match["word"].lower(), match["rest"], None)
            ):
                continue
            said = self._spoken_to(piece.strip()) if kind != "list" or not pending or ":" in piece else piece
            clause = self._reader.read(said, speaking_to=self._to) or self._gapped(said, self._last)
            if clause is None:
                self._lose(said, len(said.split()))
                continue
            if [each for each, _ in chunks[index + 1 : index + 2]] == ["after"] and kind != "after":
                done = self._afterwards(kind, said, clause, chunks[index + 1][1], start if not pending else None)
                if done is not None:
                    pending.append(done)
                    told = True
                    continue
            self._lost += clause.lost
            anew = not pending or clause.who.kind not in ("elided", "pronoun")
            how = "beside" if self._all_beside and pending and kind == "list" else kind
            firsts, ends = self._emit(how, clause, start if anew else None)
            if kind == "after" and pending:
                self._graph.order(ends, pending[-1])
            pending.append(firsts)

    def _doers(self, who: Who) -> list[str]:
        """Return the robots that a subject means now."""
        mentions = self._reader.mentions
        if who.kind in ("named", "all", "several", "the"):
            return who.robots
        if who.kind == "one":
            return ["any"]
        if who.kind == "first":
            return [mentions.group[0]] if mentions.group else ["any1"]
        if who.kind == "other":
            rest = [name for name in (self._names.roster or mentions.group) if name not in mentions.robots]
            return rest[:1] if len(rest) == 1 else ["any2"]
        if who.kind == "pronoun":
            return mentions.robots or self._to
        return self._to

    def _emit(self, kind: str, clause: Clause, beside: Snapshot | None) -> tuple[set[int], set[int]]:
        graph = self._graph
        assigned = [step.params["_robot"] for step in clause.steps if "_robot" in step.params]
        robots = assigned or self._doers(clause.who)
        explicit = clause.who.kind not in ("elided", "pronoun")
        computes = all(graph.catalogue.skills[step.skill].runs == "compute" for step in clause.steps)
        if kind in ("then", "before") and (explicit or computes) and graph.scope:
            graph.barrier |= graph.lasts(graph.scope)
        if kind in ("beside", "after"):
            if explicit and robots != self._to:
                beside = Snapshot(
                    {name: tail for name, tail in graph.tails.items() if not set(tail) & graph.scope},
                    frozenset(),
                    graph.barrier,
                )
                graph.scope = set()
            else:
                beside = graph.previous
        if explicit and robots != self._to:
            graph.thread = graph.thread if kind == "then" else frozenset()
        if self._source:
            clause.steps[0].params = self._with_source(clause.steps[0])
        firsts, ends = graph.add(list(robots), clause.steps, beside=beside)
        if explicit:
            self._names.seen.update(robots)
            self._to = list(robots)
        if not computes or explicit:
            self._mention(list(robots))
        if clause.who.kind in ("first", "other", "one", "several"):
            self._mention(list(robots))
        self._remember(clause)
        self._last = clause
        return firsts, ends

    def _with_source(self, step: Step) -> dict[str, Any]:
        manifest = self._graph.catalogue.skills.get(step.skill)
        source, self._source = self._source, ""
        return {"source": source, **step.params} if manifest and "source" in manifest.params else step.params

    def _remember(self, clause: Clause) -> None:
        mentions = self._reader.mentions
        for step in clause.steps:
            manifest = self._graph.catalogue.skills[step.skill]
            for key in ("object", "target", "asset", "source"):
                if value := step.params.get(key):
                    mentions.thing = str(value)
            if "load" in manifest.ties or step.fetch:
                mentions.held = str(step.params.get("object", ""))
            if "load" in manifest.frees:
                mentions.held = ""
            for key in ("place", "area", "station"):
                if value := step.params.get(key):
                    mentions.place = str(value)
                    if step.skill == "goto":
                        mentions.thing = str(value)
            if step.at:
                mentions.place = step.at
            if (to := step.params.get("to")) and step.skill in ("give", "say", "ask", "notify", "report"):
                mentions.person = str(to)
            if model := step.params.get("model"):
                mentions.model = str(model)

    def _lose(self, piece: str, words: int) -> None:
        said = self._reader.unquote(" ".join(piece.split())).strip(" ,.:;")
        bare = lx.FILLER.sub("", said).strip(" ,.:;")
        if bare:
            self._pieces.append(said)
            self._lost += words
