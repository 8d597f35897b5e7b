"""Alerts: what operators have to know of and do something about, kept by the fleet so that all of them see the same.

`rules` decides which there are, from facts, and what becomes of those that are kept; it is pure. `keeper` is its shell
on each gateway: it gathers the facts, writes the records, publishes each change and answers operators.
"""

from appliance.alerts.keeper import Keeper
from appliance.alerts.rules import ordered

__all__ = ["Keeper", "ordered"]
