"""What federated learning computes, alike on a gateway and in a container: numpy and the standard library only.

`shards` (models as lists of safetensors files, and the check of such files against a manifest), `sums` (weighted sums
that do not depend on order), `robust` (rules that bear hostile updates), `coding` (updates in 8 bits), `seeds`. A
handler says `from _lib.learning import shards`, a gateway `from appliance.skills._lib.learning import shards`.
"""
