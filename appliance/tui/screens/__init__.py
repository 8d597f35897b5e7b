"""The screens of the terminal UI: titles and number keys are in `actions.SCREENS`, their classes in `app.SCREENS`.

Opened from other screens, and so not in those tables: `takeover`, `review` and `submit`.
"""
