"""Warm containers on this gateway: Podman, the runner, selection, health.

Doors:
    pool.Pool            select, run, cancel, drain: what the task manager uses
    selection            Algorithm 1 as plain functions; Candidate, Decision
    images               build and list the images that skills run in
    engine.remove_fleet  remove a fleet's containers and volumes from this machine
    settings.PoolConfig  section `[pool]` of a gateway's file

Inside, from above to below: pool (the door), conversation (one run), keeper (the books), policies (eviction,
prewarming, costs), starter (what a container is), container (its connections), engine (Podman), runner (what
runs within).
"""
