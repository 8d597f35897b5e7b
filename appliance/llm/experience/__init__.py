"""What became of plans, and what follows for the next ones: the closed loop.

`outcomes` reads a task's last record, `statistic` adds up by skill and robot, both pure; `memory` keeps it all in the
gateway's store and answers for it.
"""
