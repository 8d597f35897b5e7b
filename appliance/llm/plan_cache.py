"""The plan cache, first tier of the cascade: plans that were carried out with success, and their keys. Pure.

A plan comes in only when a task with it has succeeded without a revision, and goes for good when one with it fails: a
cache of plans that were never carried out would repeat mistakes at full confidence. It is bounded; the plan that was
used longest ago goes first. A plan that is taken out is checked again like any other.

The same words, for the same fleet, under the same rules, have the same key. The instruction is brought to one form as
far as that cannot change what it means: typography, blanks, case outside quotes, courtesy at its ends. Whatever else a
plan depends on goes into the key as a digest, so that a change of the roster, the catalogue, the site or the policy
makes every earlier plan unreachable at once.
"""

import hashlib
import re
import unicodedata
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from appliance.llm.settings import PlanContext
from appliance.model import CacheFigures, Plan, RobotInfo, Site, encode
from appliance.skills.catalogue import Catalogue, SkillManifest

_QUOTES = str.maketrans({"“": '"', "”": '"', "„": '"', "«": '"', "»": '"', "‘": "'", "’": "'", "–": "-", "—": "-"})
_BEFORE = re.compile(r"^(?:please|kindly|hey|hi|hello|ok|okay)\b[ ,:]*", re.IGNORECASE)
_AFTER = re.compile(r"[ ,]*\b(?:please|thanks|thank you)$", re.IGNORECASE)
_SPOKEN = re.compile(
    r"\b(?:say|says|saying|tell|telling|speak|announce|reply|answer|greet|shout|call|write|type|read|send|notify)\b",
    re.IGNORECASE,
)
"""Words after which a courtesy may be what is to be said, and no courtesy."""
_QUOTED = re.compile(r'"[^"]*"')


def canonical(instruction: str) -> str:
    """Return an instruction in the form by which it is compared."""
    text = unicodedata.normalize("NFKC", instruction).translate(_QUOTES)
    text = " ".join(text.split()).rstrip(" .!")
    before = None
    while before != text:
        before, text = text, _BEFORE.sub("", text).strip(" .!")
        if _SPOKEN.search(_QUOTED.sub("", text)) is None:
            text = _AFTER.sub("", text).strip(" .!")
    # What is quoted keeps its case: it may be read out, or typed.
    parts, at = list[str](), 0
    for match in _QUOTED.finditer(text):
        parts += [text[at : match.start()].casefold(), match[0]]
        at = match.end()
    return "".join([*parts, text[at:].casefold()])


def digest(*facts: Any) -> str:
    """Return a digest of facts that can be written as JSON."""
    return hashlib.sha256(encode(facts)).hexdigest()[:16]


def roster_digest(robots: Sequence[RobotInfo] | None) -> str:
    """Return what of the roster a plan depends on: who there is and what they can do, not where they are."""
    if robots is None:
        return "unknown"
    return digest(sorted((each.id, sorted(each.uses), sorted(each.verbs), each.flies) for each in robots))


def catalogue_digest(catalogue: Catalogue) -> str:
    """Return what of the catalogue a plan depends on."""
    return digest(
        [(each.id, each.runs, each.uses, _params(each), each.implemented) for each in catalogue.skills.values()]
    )


def _params(skill: SkillManifest) -> list[tuple[str, str, bool]]:
    return sorted((name, param.type, param.required) for name, param in skill.params.items())


def site_digest(site: Site | None) -> str:
    """Return what of the site a plan depends on: names, areas and limits."""
    return "unknown" if site is None else digest(site)


def plan_key(context: PlanContext, *, catalogue: str, policy: str) -> str:
    """Return the key of a context's plan; "" for one that is not to be cached.

    Args:
        context: what is known of the instruction. A task that has begun is like no other.
        catalogue: digest of the catalogue.
        policy: digest of what may be planned, and by whom.
    """
    if context.so_far is not None:
        return ""
    facts = (
        canonical(context.instruction),
        roster_digest(context.robots),
        catalogue,
        site_digest(context.site),
        policy,
    )
    return digest(*facts, context.submitter if context.from_robot else "")


MOST = 512
"""Plans; at 3 kB each a megabyte and a half. The orders of a shift repeat within far fewer."""
MOST_BYTES = 32 * 1024
"""A larger plan is not kept: it repeats rarely, and a few would take the room of hundreds."""


class Kept(Struct, frozen=True, kw_only=True):
    """A plan and what became of it."""

    plan: Plan
    good: int = 1
    """Tasks that succeeded with it."""
    sure: float = 0.0
    """How sure the tier was that made it."""

    @property
    def confidence(self) -> float:
        """The tier's own confidence counts as one task, each success as another."""
        return (self.good + self.sure) / (self.good + 1)

    @property
    def told(self) -> str:
        """How it got here, in words."""
        first = self.plan.provenance
        by = first.tier.value if first is not None else self.plan.tier.value
        model = f" ({first.model})" if first is not None and first.model else ""
        times = "once" if self.good == 1 else f"{self.good} times"
        return f"the same instruction, fleet and rules: planned by {by}{model}, carried out with success {times}"


class PlanCache:
    """Plans by key.

    Args:
        most: plans that are kept.
    """

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._kept: OrderedDict[str, Kept] = OrderedDict()
        self._hits = 0
        self._misses = 0
        self._dropped = 0

    def find(self, key: str) -> Kept | None:
        """Return the plan of a key, if there is one."""
        found = self._kept.get(key) if key else None
        if found is None:
            self._misses += 1
            return None
        self._hits += 1
        self._kept.move_to_end(key)
        return found

    def succeeded(self, key: str, plan: Plan) -> Kept | None:
        """Note that a task with a plan has succeeded; returns what is kept from now on, None when nothing is."""
        if not key or self._most <= 0:
            return None
        known = self._kept.get(key)
        if known is not None and known.plan.subtasks == plan.subtasks:
            kept = replace(known, good=min(known.good + 1, 1_000_000))
        else:
            kept = Kept(plan=plan, sure=plan.provenance.confidence if plan.provenance else plan.confidence)
        self._kept[key] = kept
        self._kept.move_to_end(key)
        return kept

    def failed(self, key: str) -> bool:
        """Forget the plan of a key, since a task with it has failed; whether there was one."""
        gone = self._kept.pop(key, None) is not None
        self._dropped += gone
        return gone

    def surplus(self) -> list[str]:
        """Forget what is beyond the bound, and return its keys."""
        gone = list[str]()
        while len(self._kept) > self._most:
            gone.append(self._kept.popitem(last=False)[0])
        return gone

    def load(self, key: str, kept: Kept) -> None:
        """Take in what was kept before."""
        self._kept[key] = kept

    @property
    def figures(self) -> CacheFigures:
        """How it does since the start."""
        return CacheFigures(entries=len(self._kept), hits=self._hits, misses=self._misses, dropped=self._dropped)
