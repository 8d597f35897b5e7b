"""The key of a plan in the plan cache: the same words, for the same fleet, under the same rules, have the same key.

The instruction is brought to one form as far as that cannot change what it means: typography, blanks, case outside
quotes, courtesy at its ends. Whatever else a plan depends on goes into the key as a digest, so that a change of the
roster, the catalogue, the site or the policy makes every earlier plan unreachable at once.
"""

import hashlib
import re
import unicodedata
from collections.abc import Sequence
from typing import Any

from appliance.llm.settings import PlanContext
from appliance.model import RobotInfo, Site, encode
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
