"""What the cascade decides by before and beside asking tiers: cache, thresholds, breaker, budget, privacy, its queue.

All of it is pure, with the clock passed in; the cascade asks and tells.
"""
