"""Checks of a plan: each a pure function of the plan, the words, the roster, the site and the limits.

`review` runs them as one ordered list. `schema` (form, catalogue, roster, capability), `places` (site, fence, units and
geographic pairs), `safety` (the operator's limits; every name stands in the words), `consistency` (annotation rules,
order and exclusivity), `wording` (every word stands in the plan: negation, exception, condition, time, alternatives,
polarity of verbs; what is left over is part of an order by the grammar of `clauses`), `robots` (those that nobody
named), `things` (what is picked up is where the robot goes). They look at a plan through `facts`, at its instruction
through `reading` and `lexicon`.
"""
