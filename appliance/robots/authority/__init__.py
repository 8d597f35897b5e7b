"""Who may command a robot just now: soft stops, and leases of operators who have taken one over."""
