"""Task manager: the life of a task, placement, runs, recovery."""
