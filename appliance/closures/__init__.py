"""Places that are closed and robots in maintenance: kept by the fleet, known on every gateway without asking.

Doors: `keeper.Closures`, `keeper.resolve`.
"""
