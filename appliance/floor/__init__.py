"""The floor that robots share: places and ways are reserved before a robot moves, so that no two come too near.

Doors: `keeper.FloorKeeper` (moves the robots of one gateway's runs), `decide` and `mover` (the decider, pure),
`geometry`, `sight`, `settings`, `decisions` (for the log, to be made again).

Inside: `geometry` (cells that a robot sweeps), `decide` (may it go, which way, whom it waits for, who gives way),
`mover` (one command's steps), `sight` (what is seen of robots), `trips` (where commands lead), and `keeper`, the shell
that reserves by leases of the plane and sends the commands.
"""
