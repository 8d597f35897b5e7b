"""Measurements of the recorder: its writer beside the bare library, from put to file, and what a kill leaves."""
