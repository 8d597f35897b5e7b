"""The terminal UI: a Zenoh client, nothing more.

Doors: `app.run_tui` (what `swiftbot tui` runs), `app.SwiftbotApp`, `app.export_picture` (the README's picture).
`board` keeps what was heard, `data` hears it and asks the fleet; neither knows of Textual. `drawing` makes text of
it, `panes`, `dialogs` and `app` show it, `actions` is the one list behind keys, help and command palette.
"""
