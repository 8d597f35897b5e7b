"""MCAP: recorder, rotation, recovery, reading back.

Doors: `settings.RecordConfig`; `recorder.Recorder` and `recorder.run_recorder` (a process of its own, `swiftbot
record`); `foxglove_bridge.serve` for the live view; `reader.info`, `reader.read`, `edit`, `player` and `retention.pin`
for files; `remote_control` for commands to recorders and players; `models` for what they speak in. Knows the plane's
session and key names, and nothing of tasks, pools or robots.
"""
