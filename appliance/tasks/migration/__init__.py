"""Moving runs in progress from one gateway to another (paper, Figure "Reschedule a task").

Four steps: *request* (`shedding`, `draining`, an operator), *fetch by key* and *find closest node* (`moving` and
`closest`, at the coordinator of the task), *migrate* (`moving`, with `leaving` on the gateway that gives the run away
and `taking` on the one that takes it). `overload` decides without I/O which runs a gateway gives away, and when.
"""
