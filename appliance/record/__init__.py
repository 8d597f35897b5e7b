"""MCAP: recorder, rotation, recovery, reading back.

Doors: `settings.RecordConfig`; `recorder.Recorder` and `recorder.run_recorder` (a process of its own, `swiftbot
record`); `reader.info`, `reader.read`, `edit` and `cat` for files; `facts` for what they speak in. Knows the
plane's session and key names, and nothing of tasks, pools or robots.
"""
