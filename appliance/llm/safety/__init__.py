"""Deterministic checks of plans beside `validate`, by the operator's policy: they refuse, or have a person look.

`checks` is the policy on skills, places, limits and exclusive places; `contradictions` finds orders that cannot both be
carried out; `grounding` finds what the instruction does not say; `confirming` says why an operator should agree first.
All are pure. `quoting` shows foreign text to models as data.
"""
