"""A fleet of real gateways under failure: tasks with effects that are counted while gateways are killed and cut off."""
