"""The plane: Zenoh session, key space, membership, ring, replicated records and registry; knows nothing of tasks.

Doors: `node.Plane` (a gateway's part in the fleet), `client.PlaneClient` (everybody else's) and `node.run_router` (what
links a large fleet), with `settings` and `events` (the fleet's, in one order). What they are made of is used where less
will do: `session.Session` with `session.Closer`, `session.Message` and `session.Publisher`, `rpc.Rpc`, `dht.Dht` with
`dht.Record` and `dht.LeaveOut`, `records` (their versions), `store.Store`, `dedup.Deduplicator`, and `backlog` (for
recorders). What a majority grants is a `leases.Lease`, or of parts of a key a `leases.Claim`; answers on parts can be
made again from a log (`leases.GrantCase`, `leases.grant_again`). A backup copies the store's file (`node.STORE_FILE`),
and a restore raises its fence (`leases.FENCE`).

From below:

- `settings` (the keys are `model.keys`, requests and replies `model.plane_api`),
- `link` (opens a Zenoh session) and `session.Session` (put, subscribe, query, serve, liveliness), whose puts are
  numbered by `backlog` so that a recorder can fetch what it lacks; `dedup` for messages that come twice,
- `rpc.Rpc` (typed requests from one gateway to another),
- `ring` (where a key belongs; pure) and `membership` (who is there, and failure detection),
- `records` (versions, and what becomes of a record when they meet; pure) and `store.Store` (what must not be
  forgotten),
- `dht.Dht` (records with compare-and-set), `anti_entropy` (which keeps the copies in step), `leases.Leases` (mutual
  exclusion by a majority),
- `registry.Registry` (the latest facts of the fleet).

`overlay` is the ring of a fleet too large for everybody to know everybody; pure, and simulated only.
"""
