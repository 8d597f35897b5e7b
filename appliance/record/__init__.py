"""MCAP: recorder, rotation, recovery, reading back."""
