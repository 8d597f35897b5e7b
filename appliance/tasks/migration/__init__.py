"""Moving runs in progress from one gateway to another (paper, Figure "Reschedule a task").

Four steps: *request* (`gateway`: load shedding, draining, an operator), *fetch by key* and *find closest node*
(`moving` and `policy`, at the coordinator of the task), *migrate* (`moving`, by `tasks.handoff`).
`policy` decides without I/O which runs a gateway gives away and when, and which gateway takes one.
"""
