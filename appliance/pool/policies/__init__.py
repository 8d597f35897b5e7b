"""What to keep, what to give up and what to start ahead, as plain code: state and event in, decisions out.

Doors:
    Planner      the one object the manager (and the simulator) talks to
    View, Idle   what it is shown; Start, Retire: what it answers
    ColdCosts    what a cold start of an image costs here
    Quarantine   images that do not start, and why

Inside, from above to below: planner, eviction (who goes first), forecast (demand, and what will be wanted).
"""

from appliance.pool.policies.eviction import ColdCosts, Evictor, Idle, Retire, Start, View
from appliance.pool.policies.planner import Planner, PlannerState, Quarantine

__all__ = ["ColdCosts", "Evictor", "Idle", "Planner", "PlannerState", "Quarantine", "Retire", "Start", "View"]
