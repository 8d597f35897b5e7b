"""What runs inside every container: a zygote that forks one child a run. Standard library only.

This folder is mounted at `/runner` and started with `python3 -m runner.main`; nothing of the appliance is
there, so any image with Python can be a skill's image. The modules:

    main.py      reads what it is to be, and starts the zygote
    zygote.py    listens, forks ahead, hands orders over, watches children, ends them
    process.py   one child as the zygote sees it: its process, its end, what is swept up after it
    preload.py   what is loaded before the first run, each item within bounds
    child.py     one run in a forked child: captured output, the handler, its outcome
    limits.py    the limits of a child
    context.py   `ctx`, what a handler sees
    link.py      a run's connection to its gateway
    frames.py    the wire: length-prefixed JSON
    spec.py      what this container is to serve, as its gateway wrote it down
"""
