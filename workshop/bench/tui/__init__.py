"""How the terminal UI keeps up with a large busy fleet, beside a plain table that is rewritten.

Doors: `run.run`. `feed` is the fleet, a process that puts facts on the plane; `screen` is a UI, another process, that
is drawn into a terminal which only counts.
"""
