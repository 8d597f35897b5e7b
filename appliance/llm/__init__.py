"""Instruction to validated plan: the cascade of tiers and what belongs to each.

Doors: `settings` (configuration, `PlanContext`, `PlanOutcome`), `cascade.Decomposer`, `checks.schema.validate`,
`review.review`. Way of an instruction: `preprocessing` -> `plan_cache` -> `tiers` in order, as `routing` allows ->
`completion` -> `review` by `checks`; `feedback` keeps what became of the plans. Tiers keep the contract in `tier`:
`local` with `worker` and `decoder` (the model's process) over the plan `language`, `peers`, `upstream`, and `rules`.

Importing the room costs nothing: the local tier's library lives in a process of its own, and the HTTP client is loaded
when it is first used.
"""
