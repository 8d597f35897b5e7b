"""Measurements of the planner: how good its plans are, what escalating unsure ones brings, how it bears load."""

from workshop.bench.plan.quality import default_cases, run

__all__ = ["default_cases", "run"]
