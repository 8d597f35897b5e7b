"""What the other end of a link is called."""

Address = tuple[str, int]
"""Host and port of the other end; of a serial link its device and 0."""
