"""Federated learning on top of tasks."""
