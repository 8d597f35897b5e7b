"""The rule-based tier: a parser for plain imperative forms, the last resort when no model can answer.

Doors: `tier.RulesTier`, `tier.read`. Way of an instruction: `wording` (sentences) -> `parser` (clauses and what stands
between them) with `conditions` (what waits for what) -> `clauses` (who, verb, quantities) -> `grammar` (what a verb
phrase asks for; its parts are `sensing`, `telling`, `moving`, `handling`) -> `graph` (subtasks and dependencies).
`lexicon`, `modifiers` and `names` hold the words. Follows the annotation rules of the decomposition set.
"""
