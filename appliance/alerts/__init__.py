"""Alerts: what operators have to know of and do something about, kept by the fleet so that all of them see the same.

Doors: `settings.AlertsConfig`; `keeper.Keeper` and `keeper.disk_mb`; `delivery` (`Delivery`, `read_addresses`), which
imports Apprise only where alerts are delivered; `messages.sender`; `rules`.

`rules` decides which there are, from facts, and what becomes of those that are kept; it is pure. `keeper` is its shell
on each gateway: it gathers the facts, writes the records, publishes each change and answers operators. `delivery` takes
them outside of the fleet, by webhook, e-mail and other services: `messages` decides what, when and by which gateway; it
is pure.
"""
