"""The terminal UI: a Zenoh client, nothing more."""
