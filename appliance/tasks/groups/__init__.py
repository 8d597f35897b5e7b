"""Dynamic groups: which gateways may serve a task, and which of them leads (paper, Dynamic Groups)."""
