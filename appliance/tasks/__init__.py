"""Task manager: the life of a task, placement, runs, recovery.

Doors: `manager.TaskManager` with `endpoints.Questions`; `executor.Executor` with `executor.Telling`,
`handler_calls.Calls`, `artifacts`, `enquiries.Enquiries` and `audit.Audit`; `offload.RemoteContainers`;
`handoff.Holds`, `handoff.Reservations` and `handoff.Source` with `migration.gateway.Migration` and
`migration.policy.Load`; `retention.Retention`, `conflicts.resolver`, `admission.refuse_commands` and `settings`: a
gateway is composed of these. For
runs that are of no task: `orders.need_of`, `checkpoints.Checkpoint` and `checkpoints.checkpoint_key`. For clients:
`stream.Kept`, `stream.Stream`, `views`, `history`, `replay`, `records.clean` and `records.done_text`.

Pure: `queue` (whose turn it is),
`records` and `model.transitions` (what is kept and what happens), `machine` (the state machine), `replan`,
`placement`, `views`, `settings`.

At the coordinator of a task: `manager` (accepts tasks and drives those whose key it owns), `endpoints` (answers for
them), `admission`, `plans`, `coordinator` (drives one task) with `steering`, `timing`, `orders`, `record_writer`,
`conflicts` and their seam to the gateway, `context`; `scheduler`, `lookahead` and `durations`; `retention`.

At the gateway that runs a subtask: `executor`, `handler_calls`, `enquiries` (questions to people), `artifacts`,
`checkpoints`. Work moves by `handoff`: `offload` passes on what has not begun, `migration` moves what is in progress.

For clients and logs: `lines` and `stream` (following a task), `audit`, `replay`.
"""
