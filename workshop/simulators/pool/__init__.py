"""Policies on traces: what the planner's decisions are worth over hours, at one gateway or a thousand, in seconds.

Doors:
    simulate     plays a trace with the settings of a pool and returns an Outcome
    traces       Poisson, bursts, diurnal, timers, and the shape of the Azure Functions workload
    recorded     traces of real fleets
    clairvoyant  what could be reached by knowing the future
"""

from workshop.simulators.pool.simulation import Outcome, simulate
from workshop.simulators.pool.traces import Arrival, Image, Trace

__all__ = ["Arrival", "Image", "Outcome", "Trace", "simulate"]
