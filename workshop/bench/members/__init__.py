"""Many lightweight members behind one router: the whole plane of each, and nothing above it.

`host` is a process with some dozens of members, `run` starts router and hosts and measures.
"""
