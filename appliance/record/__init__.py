"""MCAP: recorder, rotation, recovery, reading back.

Doors: `layout.layout`, `settings.RecordConfig`; `recorder.run_recorder` (a process of its own, `swiftbot record`) with
`segments.about`; `foxglove_bridge.serve` with `foxglove_bridge.LiveOptions` for the live view; `reader.info`,
`reader.read`, `edit`, `player` and `retention.pin` for files; `remote_control` for commands to recorders and players;
`segments.VERSION` of the program,
`segments.versions` of what it runs with; `redact.Redactor` and `redact.REDACTED`; `models` for what they speak in.

Inside: segments (one file after another, with what each begins with), mcap_writer, backfill (what was missed),
incidents, redact, schemas. Knows the plane's session and key names, and nothing of tasks, pools or robots.
"""
