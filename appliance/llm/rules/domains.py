"""What an instruction is mainly about, from the skills of its plan.

A plan's domain is the domain of its main purpose: what is only the way there, or only tells of it, does not count
unless there is nothing else. A delivery is manipulation when it ends in `place`, interaction when it ends in `give`.
"""

from collections import Counter
from collections.abc import Sequence

from appliance.model import Subtask
from appliance.skills.catalogue import Catalogue

_WEAK = frozenset({"goto", "takeoff", "land", "hold", "return_home", "dock", "wait_for", "notify", "report", "compare"})
_STRONG = ("coordination", "learning", "media")
"""Where one of their skills stands, the others serve it."""


def domain_of(subtasks: Sequence[Subtask], catalogue: Catalogue) -> str:
    """Return the domain of a plan's main purpose."""
    known = [each.skill for each in subtasks if each.skill in catalogue.skills]
    main = [skill for skill in known if skill not in _WEAK]
    if "give" in main or "handover" in main:
        main = [skill for skill in main if skill != "pick"]
    if not main:
        main = [skill for skill in known if skill != "notify"] or known
    domains = Counter(catalogue.skills[skill].domain for skill in main)
    for strong in _STRONG:
        if domains.get(strong):
            return strong
    return domains.most_common(1)[0][0] if domains else catalogue.domains[0]
