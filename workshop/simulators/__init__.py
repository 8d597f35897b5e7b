"""Simulations of the product's own deciders: pools, migration, the ring. No process, no network."""
