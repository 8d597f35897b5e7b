"""Warm containers on this gateway: Podman, the runner, selection, health."""
