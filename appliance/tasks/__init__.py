"""Task manager: the life of a task, placement, runs, recovery.

Pure: `records` and `transition` (what is kept and what happens), `machine` (the state machine), `replan`, `placement`,
`views`, `settings`.

At the coordinator of a task: `manager` (accepts tasks and drives those whose key it owns), `endpoints` (answers for
them), `admission`, `plans`, `coordinator` (drives one task) with `steering`, `timing`, `orders`, `record_writer`,
`conflicts` and their seam to the gateway, `context`; `scheduler`, `lookahead` and `durations`; `retention`.

At the gateway that runs a subtask: `executor`, `offload` (to other gateways), `handler_calls`, `enquiries` (questions
to people), `artifacts`, `checkpoints`. `migration` moves runs in progress.

For clients and logs: `api` (RPC structs), `lines` and `stream` (following a task), `audit`, `replay`.
"""
