"""The DHT beside its alternatives: simulated to 10,000 gateways with the plane's own code, and live on loopback.

`simulation` counts hops, moved keys, lookups under failure and bytes, beside the figures published for Chord
(`chord`); `live` measures 16 gateways beside 16 nodes of the `kademlia` package in the same run.
"""
