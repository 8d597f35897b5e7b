"""Is what is typed what moves? Adversarial and plain instructions with what must happen: run, hold, refuse or stop."""

from workshop.bench.intent.cases import Case, read_cases
from workshop.bench.intent.measure import measure

__all__ = ["Case", "measure", "read_cases"]
