"""One stream of what happens to a task: progress, figures and log lines of all gateways, in order as well as can be.

`lines` makes lines of what is said on the key space, `kept` is what each gateway still knows of its own, `merge` puts
lines of several clocks into one order, `stream` is the client that follows a task to its end.
"""
