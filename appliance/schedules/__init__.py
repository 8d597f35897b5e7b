"""Schedules of instructions, and saved instructions with parameters.

`due` decides when a schedule is due, and what is missed (pure); `instructions` puts parameters in their places (pure);
`records` are their keys and which version stands after a partition; `manager` submits the tasks of the schedules whose
records this gateway owns, and answers for both.

Doors: `manager.ScheduleManager`, `due.check`, `due.upcoming`, `due.when`, `due.times_text`, `due.local_zone`,
`instructions`, `records.resolve`, `records.made_name`.
"""
