"""Warm containers on this gateway: Podman, the runner, selection, health.

Doors:
    pool.Pool            select, run, cancel, drain: what the task manager uses
    pool.Verbs           warm, evict, release, hint, decisions: what operators and other gateways ask (`api`)
    selection            Algorithm 1 as plain functions; Candidate, Decision
    decisions            what was decided and why; traces for the log, and the same code deciding them again
    fair_queue           who is next among those who wait; the task manager queues by it too
    images               build and list the images that skills run in (`wheels`: their Python packages)
    volumes, transfer    state volumes and images that move between gateways (`lineage`: which state is newer)
    engine.remove_fleet  remove a fleet's containers, and if asked its volumes, from this machine
    settings.PoolConfig  section `[pool]` of a gateway's file

Inside, from above to below: pool (the door), runs (runs in progress), manager (containers started ahead, probed,
replaced, given up), allocator (which run has which container, which wait), policies (what to keep, give up and start),
pressure (memory), starter (what a container is), state (what it asks of volumes), snapshots (the code that it mounts),
container (its connections), engine (Podman), runner (what runs within). Of state volumes: volumes (whose state is the
newest), volume_store (which is here, and its files).
"""
