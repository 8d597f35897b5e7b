"""The rule-based tier: a parser for plain imperative forms, the last resort when no model can answer.

Doors: `tier.RulesTier`, `tier.read`. Way of an instruction: `parser` (sentences, clauses, order) -> `clauses` (who,
verb, quantities) -> `phrases` and `handling` (what a verb phrase asks for) -> `graph` (subtasks and dependencies).
`lexicon`, `modifiers` and `names` hold the words. Follows the annotation rules of the decomposition set.
"""
