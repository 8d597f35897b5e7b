"""Warm containers on this gateway: Podman, the runner, selection, health.

Doors: `pool.Pool` (select, run, cancel, drain: what the task manager uses; its verbs are what operators and other
gateways ask) with `pool.Call` and `allocator.WithdrawnError`; `settings`; `selection` (Algorithm 1 as plain functions);
`fair_queue` (who is next among those who wait; the task manager queues by it too); `decisions` (traces for the log, and
the same code deciding them again); `images` (build and list the images that skills run in); `signed` (which skills
may run); `volumes` (state volumes,
and how they and images move between gateways) with `volumes.registry.Volumes` and `volumes.transfers.Transfers`;
`engine` (Podman, for checks of a machine).

Inside, from above to below: pool (the door), runs (runs in progress), manager (containers started ahead, probed,
replaced, given up), allocator (which run has which container, which wait), policies (what to keep, give up and start),
pressure (memory), starter (what a container is), snapshots (the code that it mounts), container (its connections),
engine (Podman), runner (what runs within).
"""
