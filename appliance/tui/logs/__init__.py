"""What is said on the plane, line by line: gateways' log lines, and any key that an operator types.

`lines` makes a line of any message, `tail` keeps the last ones that a filter lets through; both are pure. `view` draws
only what is visible, `screen` puts it together.
"""
