"""What runs inside every container: a zygote that forks one child a run. Standard library only.

This folder is mounted at `/runner` and started with `python3 -m runner.main`; nothing of the appliance is
there, so any image with Python can be a skill's image. The modules:

    main.py      the zygote: listens, forks, watches children, ends them, cleans up after them
    child.py     one run in a forked child: limits, output capture, the handler, its outcome
    context.py   `ctx`, what a handler sees
    frames.py    the wire: length-prefixed JSON
"""
