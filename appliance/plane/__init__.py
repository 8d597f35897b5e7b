"""The plane: Zenoh session, key space, membership, ring, replicated records and registry; knows nothing of tasks."""
