"""Clauses that ask for skills of an operator's own, read by the phrases of their manifests. Pure.

The built-in grammar knows the built-in skills. A skill in a folder of its own is asked for by one of its phrases and,
where it has a parameter of text, the thing behind it: "polish the handrail at dock 2".
"""

import re

from appliance.llm.checks.accounting import forms
from appliance.llm.rules.phrases import ARTICLE, LOCATION, Scope, Step
from appliance.skills.catalogue import SKILLS, Catalogue, SkillManifest


class AddedSkills:
    """The skills of a catalogue that are not built in, with the patterns of their phrases, longest first.

    Args:
        manifests: of the skills; those without phrases cannot be asked for.
    """

    def __init__(self, manifests: tuple[SkillManifest, ...]) -> None:
        phrases = sorted(
            ((phrase, each) for each in manifests for phrase in each.phrases), key=lambda pair: -len(pair[0])
        )
        self._patterns = [(_pattern(phrase, each), each) for phrase, each in phrases]
        self.verbs = frozenset(form for phrase, _ in phrases for form in forms(phrase.split()[0]))
        """First words of the phrases, in all forms."""

    def __bool__(self) -> bool:
        """Whether there are any phrases."""
        return bool(self._patterns)

    @staticmethod
    def of(catalogue: Catalogue) -> "AddedSkills":
        """Return those of a catalogue."""
        return AddedSkills(tuple(each for each in catalogue.skills.values() if each.folder.parent != SKILLS))

    def step(self, text: str, scope: Scope) -> Step | None:
        """Return the step that a clause without subject and quantities asks for, or None."""
        for pattern, manifest in self._patterns:
            if match := pattern.fullmatch(text.strip(" ,")):
                groups = match.groupdict()
                params = {name: scope.thing(groups["what"]) for name in _texts(manifest)[:1] if groups.get("what")}
                at = scope.place(groups["loc"]) if groups.get("loc") else ""
                return Step(manifest.id, params, at=at)
        return None


def _texts(manifest: SkillManifest) -> list[str]:
    """The parameters of text, those that are required first."""
    texts = [name for name, each in manifest.params.items() if each.type == "string"]
    return sorted(texts, key=lambda name: not manifest.params[name].required)


def _pattern(phrase: str, manifest: SkillManifest) -> re.Pattern[str]:
    verb, *rest = phrase.split()
    words = [f"(?:{'|'.join(map(re.escape, sorted(forms(verb))))})"]
    words += [f"{ARTICLE}{re.escape(word)}" for word in rest if word not in ("the", "a", "an")]
    texts = _texts(manifest)
    thing = r" (?P<what>.+?)" if texts else ""
    if texts and not manifest.params[texts[0]].required:
        thing = f"(?:{thing})?"
    return re.compile(f"{' '.join(words)}{thing}{LOCATION}", re.IGNORECASE)
