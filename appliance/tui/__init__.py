"""The terminal UI: a Zenoh client, nothing more.

Doors: `app.run_tui` (what `swiftbot tui` runs), `app.SwiftbotApp`, `serve.serve` (what `swiftbot tui --serve` runs),
`settings`, `widgets.map` (a map in a terminal, also for `swiftbot site show`).

`store` keeps what was heard, `subscriptions` hears it and asks the fleet, `replay` takes it from a log; none knows of
Textual. `actions` is the one list behind keys, help and command palette, `command_line` reads what is typed.
`formatting`, `status_styles`, `task_view`, `robot_view` and `plan_editor` make rows and text of facts. A screen is a
`base_screen.FleetScreen`; `screens` has all of them, `widgets` what they are made of.
"""
