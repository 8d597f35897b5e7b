"""Warm containers on this gateway: Podman, the runner, selection, health.

Doors:
    pool.Pool            select, run, cancel, drain: what the task manager uses
    verbs.Verbs          warm, evict, release, hint, decisions: what operators and other gateways ask (`api`)
    selection            Algorithm 1 as plain functions; Candidate, Decision
    images               build and list the images that skills run in (`wheels`: their Python packages)
    volumes, transfer    state volumes and images that move between gateways
    engine.remove_fleet  remove a fleet's containers, and if asked its volumes, from this machine
    simulator.simulate   what the policies make of hours of arrivals, without a container
    settings.PoolConfig  section `[pool]` of a gateway's file

Inside, from above to below: pool (the door), running (runs in progress), conversation (one run), keeper (tending:
starts ahead, probes, replaces, gives up), planning (what the policies are shown, and what they mean here), books (who
has which, who waits), policies (what to keep, give up and start), pressure (memory), starts (starts in progress,
quarantine), starter (what a container is), snapshots (the code that it mounts), container (its connections), link and
engine (Podman), runner (what runs within). Of state volumes: volumes (whose state is the newest), ledger (which is
here), folders (its files).
"""
