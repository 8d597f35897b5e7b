"""`python -m workshop.corpus`: check every pair and count what they cover, for their writers.

Ends with 1 when a pair breaks the rules. Copies of test cases are looked for by the tests, which have the test set.
"""

import sys
from collections import Counter

from appliance.skills.catalogue import load_catalogue
from workshop.corpus import load
from workshop.corpus.check import problems, tally, too_near


def main() -> int:
    """Print what is wrong, then the counts; return the exit status."""
    catalogue = load_catalogue()
    corpus = load()
    wrong = [f"{where}: {text}" for where, pair in corpus.items() for text in problems(pair, catalogue)]
    wrong += too_near({where: (pair.instruction, pair.subtasks) for where, pair in corpus.items()})
    counted = tally(corpus.values())
    for line in wrong:
        print(line)
    print(f"{counted.pairs} pairs, {counted.refused.total()} of them without a plan")
    for name, counts in (
        ("domains", counted.domains),
        ("subtasks", Counter({str(length): count for length, count in sorted(counted.lengths.items())})),
        ("refusals", counted.refused),
        ("skills", counted.skills),
        ("voices", counted.voices),
        ("sources", counted.sources),
    ):
        listed = counts.items() if name == "subtasks" else counts.most_common()
        print(f"{name}: {', '.join(f'{key} {count}' for key, count in listed)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
