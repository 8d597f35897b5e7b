"""Instruction to validated plan: the cascade of tiers and what belongs to each.

Doors: `cascade.Decomposer` with `peers.PeerTier`; `settings`; `stop_words` with `preprocessing.stop_refused`;
`training_words` with `preprocessing.training_refused`; `rule_words`; `checks.schema` (whether a plan can be run at
all), `checks.safety.strictest`, `checks.safety.out_of_use`, `checks.safety.kept_from` and `checks.safety.involved`;
`batch` (many instructions of a file).

Way of an instruction: `preprocessing` -> `plan_cache` -> `tiers` in order, as `routing` allows ->
`completion` -> `review` by `checks`; `feedback` keeps what became of the plans. Tiers keep the contract in `tier`:
`local` with `worker` and `decoder` (the model's process) over the plan `language`, `peers`, `upstream`, and `rules`.

Importing the room costs nothing: the local tier's library lives in a process of its own, and the HTTP client is loaded
when it is first used.
"""
