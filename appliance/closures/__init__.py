"""Places that are closed, robots in maintenance, standing rules: kept by the fleet, known on every gateway.

Doors: `keeper.Closures`, `keeper.resolve`.
"""
