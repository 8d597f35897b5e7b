"""The rule-based tier: a parser for plain imperative forms, the last resort when no model can answer.

Doors: `tier.RulesTier`, `tier.read`. Way of an instruction: `lexicon` (sentences) -> `parser` (clauses, what stands
between them, and what waits for what) -> `grammar` (what a verb phrase asks for) -> `graph` (subtasks and
dependencies). `lexicon` and `names` hold the words. Follows the annotation rules of the decomposition set.
"""
