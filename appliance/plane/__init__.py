"""The plane: Zenoh session, key space, membership, ring, replicated records and registry; knows nothing of tasks.

Doors: `node.Plane` (a gateway's part in the fleet), `node.PlaneClient` (everybody else's) and `node.run_router` (what
links a large fleet). They put together, from below:

- `keys` (alone knows key names; docs/keyspace.md describes every key) and `settings`,
- `link` (opens a Zenoh session) and `session.Session` (put, subscribe, query, serve, liveliness), whose puts are
  numbered by `backlog` so that a recorder can fetch what it lacks; `dedup` for whoever hears a thing twice,
- `rpc.Rpc` (typed requests from one gateway to another),
- `ring` (where a key belongs; pure) and `membership` (who is there, and failure detection),
- `records` (versions, and what becomes of a record when they meet; pure) and `store.Store` (what must not be
  forgotten),
- `dht.Dht` (records with compare-and-set), `anti_entropy` (which keeps the copies in step), `leases.Leases` (mutual
  exclusion by a majority),
- `registry.Registry` (the latest facts of the fleet).

`overlay` is the ring of a fleet too large for everybody to know everybody; pure, and simulated only.
"""
