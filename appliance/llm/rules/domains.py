"""What an instruction is mainly about, from the skills of its plan.

A plan's domain is the domain of its main purpose: what is only the way there, or only tells of it, does not count
unless there is nothing else. A delivery is manipulation when it ends in `place`, interaction when it ends in `give`.
"""

from collections import Counter
from collections.abc import Sequence

from appliance.model import Subtask
from appliance.skills.catalogue import Catalogue

_STRONG = ("coordination", "learning", "media")
"""Where one of their skills stands, the others serve it."""


def domain_of(subtasks: Sequence[Subtask], catalogue: Catalogue) -> str:
    """Return the domain of a plan's main purpose."""
    known = [each.skill for each in subtasks if each.skill in catalogue.skills]
    main = [skill for skill in known if not catalogue.skills[skill].incidental]
    if any(
        catalogue.skills[skill].domain != "manipulation" and "load" in catalogue.skills[skill].frees for skill in main
    ):
        main = [skill for skill in main if "load" not in catalogue.skills[skill].ties]
    if not main:
        main = [skill for skill in known if skill != "notify"] or known
    domains = Counter(catalogue.skills[skill].domain for skill in main)
    for strong in _STRONG:
        if domains.get(strong):
            return strong
    return domains.most_common(1)[0][0] if domains else catalogue.domains[0]
