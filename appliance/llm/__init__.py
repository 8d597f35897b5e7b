"""Instruction to validated plan: prompt, local slot, upstream, rules, cascade.

Doors: `settings.LlmConfig` and `PlanContext`, `cascade.Decomposer`, `validate.validate`. Importing the room costs
nothing: the local tier's library lives in a process of its own, and the HTTP client is loaded when it is first used.
"""
