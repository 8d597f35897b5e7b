"""Measurements of what this product promises, each beside its alternative, in one run on one machine."""
