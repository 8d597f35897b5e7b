"""The terminal UI in a browser: `swiftbot tui --serve`, on this machine's loopback, behind a token.

`guard` decides who is let in and is pure; `server` answers the browser and runs one terminal UI for each that opens it.
"""
