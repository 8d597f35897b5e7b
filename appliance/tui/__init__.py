"""The terminal UI: a Zenoh client, nothing more.

Doors: `running.run_tui` (what `swiftbot tui` runs), `app.SwiftbotApp`, `running.export_picture` (the README's picture).
`store` keeps what was heard, `data` hears it and asks the fleet; neither knows of Textual. `shell` draws, `ordering`
takes orders, `app` does what is done here; `actions` is the one list behind keys, help and command palette. A screen
is a `frame.FleetScreen`.
"""
