"""Checks of a plan: each a pure function of the plan, the words, the roster, the site and the limits.

`review` runs them as one ordered list. `schema` (form, catalogue, roster, capability), `places` (site, fence, units and
geographic pairs), `policy` (the operator's limits), `consistency` and `contradiction` (order and exclusivity),
`grounding` (every name stands in the words), `wording` (every word stands in the plan: negation, exception, condition,
time, alternatives, polarity of verbs, robots that nobody named).
"""
