"""The plane: Zenoh session, key space, membership, ring, replicated records and registry; knows nothing of tasks.

Doors: `node.Plane` (a gateway's part in the fleet) and `node.PlaneClient` (everybody else's), which put together
`session.Session` (put, subscribe, query, serve, liveliness), `rpc.Rpc`, `dht.Dht` (records with compare-and-set),
`registry.Registry` (the latest facts), `store.Store` (what must not be forgotten). `keys` alone knows key names;
`ring` and `versions` decide without I/O, and so does `overlay`, the ring of a fleet too large for everybody to know
everybody, which is simulated only. `router` links a large fleet. docs/keyspace.md describes every key.
"""
