"""Robots: MAVLink endpoint and Zenoh robots, commands out, telemetry and tasks in, and who may command them."""
