"""Checks every prerequisite of a gateway on this machine and names the remedy for each that is missing.

Doors: `run_checks` and `Check`. `checks.py` and `containers.py` decide; `machine.py` is the seam to the machine that
tests fake.
"""

from appliance.doctor.check import Check
from appliance.doctor.checks import run_checks

__all__ = ["Check", "run_checks"]
