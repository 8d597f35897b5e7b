"""Simulated robots, each a process of its own that speaks as a real one does: a MAVLink copter, a Zenoh rover."""
