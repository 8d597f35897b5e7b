"""Whether a pair may be trained on: its plan keeps the rules of plans (`appliance.llm.checks.consistency`).

What is left to the writer is the meaning.
"""

from appliance.llm.checks import consistency as sense
from appliance.skills.catalogue import Catalogue
from workshop.corpus.notation import Pair


def problems(pair: Pair, catalogue: Catalogue) -> tuple[str, ...]:
    """Return everything that is wrong with a pair, each as a sentence; nothing when it may be trained on."""
    if pair.refused:
        return ()
    meaning = sense.Meaning(
        instruction=pair.instruction, robots=pair.robots, domain=pair.domain, subtasks=pair.subtasks
    )
    return sense.problems(meaning, catalogue)
