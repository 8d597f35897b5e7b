"""Measurements of the product beside its baselines, each in one run on this machine: `swiftbot bench ...`."""
