"""The table of keys: topics, the verbs that gateways answer, and the kinds of records that they write.

Puts and subscriptions, handlers and calls, the schemas in logs, the guard of `swiftbot plane put` and the tables of
docs/keyspace.md (`scripts/write_keyspace.py`) come from here. A new key is its entry here, and its use.
"""

from functools import lru_cache
from typing import Any, cast

from appliance.model import (
    Act,
    ContainerInfo,
    Enquiry,
    GatewayStatus,
    Lease,
    Lifted,
    LogLine,
    Need,
    Notice,
    PoolHint,
    RobotCommand,
    RobotInfo,
    RobotReply,
    RunAccepted,
    RunEvent,
    RunRequest,
    Site,
    SoftStop,
    TaskRecord,
    TaskRequest,
    alerts,
    closures,
    learn_api,
    plane_api,
    planner_api,
    pool_api,
    recorder_api,
    robot_api,
    schedules,
    task_api,
    transfer_api,
)
from appliance.model.closures import Closure
from appliance.model.floor import FloorState
from appliance.model.keys import RecordKind, Topic, Untyped, Verb
from appliance.model.learning import ClientStatus, RoundRecord, RunMetric, RunRecord
from appliance.model.roles import OPERATORS, PEOPLE, Role
from appliance.model.schedules import SavedInstruction, Schedule
from appliance.model.transitions import Transition

# --- who may do what

GATEWAYS = frozenset({Role.GATEWAY})
ROBOTS = frozenset({Role.ROBOT})
OWNERS = GATEWAYS | ROBOTS
"""Who speaks for a robot: itself, or for a MAVLink vehicle its gateway."""
WATCHERS = PEOPLE | {Role.GATEWAY, Role.RECORDER}
"""Who reads the fleet."""
ALL = WATCHERS | ROBOTS
STEERING = OPERATORS | GATEWAYS
STOPPING = PEOPLE | GATEWAYS
"""A stop is open to all who may look."""
ENGINEERS = frozenset({Role.ENGINEER, Role.GATEWAY})

# --- topics

GATEWAY_ALIVE = Topic(
    "gw/{gateway}/alive",
    Untyped,
    form="token",
    writer="that gateway",
    often="while it lives",
    kept="gone with its process at once, after `plane.lease_ms` when it is frozen or cut off",
    puts=GATEWAYS,
    reads=ALL,
)
GATEWAY_ALIVE_AGAIN = Topic(
    "gw/{gateway}/alive/{number}",
    Untyped,
    form="token",
    writer="that gateway",
    often="once a gateway that it is linked to says it does not see it (a token can get lost when a link is made "
    "again); the next replaces it",
    kept="as above: a gateway is there while any of its tokens is",
    puts=GATEWAYS,
    reads=ALL,
)
STATUS = Topic(
    "gw/{gateway}/status",
    GatewayStatus,
    writer="that gateway",
    often="on change (see [How often](#how-often-and-how-old)), and every 2 s, in a fleet of more than 20 every N/10 s",
    kept="by each listener until the gateway goes",
    puts=GATEWAYS,
    reads=WATCHERS,
)
CONTAINER = Topic(
    "gw/{gateway}/pool/{container}",
    ContainerInfo,
    form="put, delete",
    inside=(
        "gateway",
        "id",
    ),
    writer="that gateway",
    often="on change (coalesced 20 ms)",
    kept="until deleted, `dead`, or the gateway goes",
    puts=GATEWAYS,
    reads=WATCHERS,
)
RPC = Topic(
    "gw/{gateway}/rpc/{verb}",
    Untyped,
    "see [Verbs](#verbs)",
    form="query",
    writer="answered by that gateway",
    often="on demand",
    answers=GATEWAYS,
)
EXCHANGE = Topic(
    "gw/{gateway}/exchange/{verb}",
    plane_api.Exchange,
    "Exchange (below)",
    inside=(
        "gateway",
        "verb",
    ),
    writer="the gateway that answered",
    often="after each answer",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
CHUNK = Topic(
    "gw/{gateway}/chunk/{digest}/{index}",
    Untyped,
    "nothing, or `zstd` → a byte and a chunk, not JSON ([Transfers](#transfers))",
    form="query",
    writer="answered by that gateway",
    often="while something moves",
    answers=GATEWAYS,
    asks=GATEWAYS,
)
TRANSFER = Topic(
    "gw/{gateway}/transfer/{transfer}",
    transfer_api.Progress,
    inside=(
        "gateway",
        "id",
    ),
    writer="the gateway where it arrives",
    often="twice a second while it moves, once at its end",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
MIGRATION = Topic(
    "gw/{gateway}/migration",
    task_api.MigrationRequest,
    'MigrationRequest `{reason, node, operation: "relocate", num_containers, requirements, runs, why}`',
    writer="a gateway that wants runs moved away: overloaded, or draining",
    often="when it does",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
DECIDED = Topic(
    "gw/{gateway}/decided/{what}",
    task_api.Decided,
    "a decision with all that it rests on: `placement` (PlacementCase, by the coordinator, when a subtask is sent), "
    "`selection` (SelectionCase) and `eviction` (EvictionCase, by the pool), `way` (WayCase, by the gateway that moves "
    "a robot) and `grant` (GrantCase, by one that grants ways), `round` (RoundCase, by the coordinator of a round of "
    "federated learning)",
    writer="that gateway",
    often="about 1 kB a run each, and each step of a round, some 10 kB a stretch of a robot's way; not with "
    "`tasks.tell_decisions`, `pool.tell_decisions`, `floor.tell_decisions` = false",
    kept="in logs only, for `swiftbot log check`",
    puts=GATEWAYS,
    reads=WATCHERS,
)
LINKS = Topic(
    "gw/{gateway}/mavlink/links",
    robot_api.LinkList,
    "LinkList `{gateway, links, routes}`: of each link rates, senders with losses, latency, what was refused",
    writer="a gateway with MAVLink links",
    often="every second",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
LINK_FRAMES = Topic(
    "gw/{gateway}/mavlink/{link}/{direction}",
    Untyped,
    "one raw MAVLink frame, not JSON, of the link with that number",
    writer="that gateway; `rx` heard from, `tx` sent to an end that is no vehicle (a ground station, a stranger); what "
    "is for everybody and only passed on stands once, as heard, and `mavlink/links` counts where it went",
    often="per frame",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
LOG = Topic(
    "gw/{gateway}/log",
    LogLine,
    writer="that gateway",
    often="per line at the level set",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
BACKLOG = Topic(
    "@backlog/{session}",
    Untyped,
    "BacklogAsk and Backlogged, MessagePack",
    form="query",
    writer="the session that put",
    often="by recorders, for what they miss",
    answers=GATEWAYS,
    asks=GATEWAYS | {Role.RECORDER},
)
TASK_UPDATE = Topic(
    "task/{task}/record",
    TaskRecord,
    inside=("id",),
    writer="the task's coordinator",
    often="on change",
    kept="the record itself is in the DHT; this is the news of it",
    puts=GATEWAYS,
    reads=ALL,
)
TRANSITION = Topic(
    "task/{task}/transition",
    Transition,
    inside=("task",),
    writer="the task's coordinator",
    often="every input of the state machine, in order",
    kept="in logs, for replay",
    puts=GATEWAYS,
    reads=WATCHERS,
)
RUN_EVENT = Topic(
    "task/{task}/run/{subtask}",
    RunEvent,
    inside=(
        "task",
        "subtask",
    ),
    writer="the executing gateway",
    often="started, progress, log, partial, checkpoint (without its data), alive, end; each but `alive` numbered per "
    "run",
    kept="the last one per run at the executing gateway",
    puts=GATEWAYS,
    reads=WATCHERS,
)
LEARN_RUN = Topic(
    "learn/{run}/run",
    RunRecord,
    writer="the gateway that has written it: a round's coordinator, or one that an operator asked",
    often="on change: a round is closed, a model evaluated, an operator's order",
    kept="the record itself is in the DHT; this is the news of it",
    puts=GATEWAYS,
    reads=WATCHERS,
)
LEARN_ROUND = Topic(
    "learn/{run}/round",
    RoundRecord,
    writer="the round's coordinator",
    often="on change: orders are sent, the round is closed; every 5 s while it is open",
    kept="as above",
    puts=GATEWAYS,
    reads=WATCHERS,
)
LEARN_CLIENT = Topic(
    "learn/{run}/client/{client}",
    ClientStatus,
    writer="the round's coordinator",
    often="on change, once a second at most",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
LEARN_METRIC = Topic(
    "learn/{run}/metric",
    RunMetric,
    writer="the gateway that has written the run's record",
    often="when a round is closed, and again when its model is evaluated",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
ROBOT_ALIVE = Topic(
    "robot/{robot}/alive",
    Untyped,
    form="token",
    writer="a Zenoh robot; for a MAVLink vehicle its gateway",
    often="while it is connected",
    puts=OWNERS,
    reads=ALL,
)
ROBOT = Topic(
    "robot/{robot}/state",
    RobotInfo,
    inside=("id",),
    writer="as above",
    often="a few times a second",
    kept="by each listener; offline after its token goes, forgotten 5 min later",
    puts=OWNERS,
    reads=ALL,
)
FLOOR = Topic(
    "floor/{robot}",
    FloorState,
    "FloorState `{robot, gateway, task, command, state, place, way, waits_for, why, ticket, waited_s, in_line, "
    "stuck}`: the way that a robot has reserved, or what it waits for",
    writer="the gateway whose run moves it",
    often="on change, and every 2 s while it moves or waits",
    kept="by each gateway, 6 s",
    puts=GATEWAYS,
    reads=WATCHERS,
)
COMMAND = Topic(
    "robot/{robot}/command",
    Untyped,
    "RobotCommand → RobotReply",
    form="query",
    writer="answered by the robot or its gateway",
    often="on demand",
    kept="replies by command id, so a repeat does nothing twice",
    answers=OWNERS,
    asks=STEERING,
)
COMMANDED = Topic(
    "robot/{robot}/commanded",
    RobotCommand,
    writer="the gateway or program that executes it",
    often="per command",
    kept="in logs only",
    puts=OWNERS,
    reads=WATCHERS,
)
CAMERA = Topic(
    "robot/{robot}/camera",
    Untyped,
    "foxglove.CompressedImage",
    writer="the robot",
    often="per picture",
    kept="in logs only",
    puts=OWNERS,
    reads=WATCHERS,
)
MAVLINK = Topic(
    "robot/{robot}/mavlink/{direction}",
    Untyped,
    "one raw MAVLink frame, not JSON",
    writer="the vehicle's gateway; `rx` from, `tx` to the vehicle",
    often="per frame",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
INTAKE = Topic(
    "robot/{robot}/task",
    TaskRequest,
    "TaskRequest; of a query TaskRequest → TaskRecord, answered by one gateway when the task is durable",
    form="put, query",
    writer="a robot",
    often="when it wants something done",
    kept="becomes a task",
    puts=ROBOTS,
    reads=WATCHERS,
    answers=GATEWAYS,
    asks=ROBOTS,
)
NOTICE = Topic(
    "notice/{to}",
    Notice,
    inside=("to",),
    writer="a gateway",
    often="by `notify`, and of its own accord; what both sides of a partition give has the same `id`, and is shown "
    "once",
    kept="in logs only",
    puts=GATEWAYS,
    reads=WATCHERS,
)
ACT = Topic(
    "operator/act/{gateway}",
    Act,
    "Act `{id, verb, by, target, why, outcome, problem, gateway, at_ns, took_ms}`",
    writer="the gateway that an operator's order was given to",
    often="per order, with what came of it",
    kept="in logs; the last 500 by every gateway, and the last 500 submissions (verb `acts`)",
    puts=GATEWAYS,
    reads=WATCHERS,
)
STOP = Topic(
    "operator/stop/{act}",
    SoftStop,
    "SoftStop `{id, robots, by, why, at_ns}`; no robots: the fleet",
    inside=("id",),
    writer="the operator's tool, then the gateway that keeps it",
    often="per soft stop",
    kept="by every gateway, on disk, until lifted and forgotten",
    puts=STOPPING,
    reads=WATCHERS,
)
LIFTED = Topic(
    "operator/resume/{act}",
    Lifted,
    "Lifted `{id, stops, robots, by, why, at_ns}`",
    inside=("id",),
    writer="the gateway that keeps it",
    often="when stops are lifted",
    kept="as above",
    puts=GATEWAYS,
    reads=WATCHERS,
)
LEASE = Topic(
    "operator/lease/{robot}",
    Lease,
    "Lease `{id, robot, by, why, lease_s, renewal, ended}`",
    inside=("robot",),
    writer="the gateway that was asked; at the end the one that saw it",
    often="when an operator takes a robot over, at each renewal, at the end",
    kept="by each gateway until it ends",
    puts=GATEWAYS,
    reads=WATCHERS,
)
ENQUIRY = Topic(
    "operator/ask/{enquiry}",
    Enquiry,
    "Enquiry `{id, question, choices, to, robot, task, subtask, expires_s, answer, by}`",
    inside=("id",),
    writer="the gateway where it is asked, or answered",
    often="when a skill or robot asks people something, and when that is answered",
    kept="the question itself is in the DHT",
    puts=GATEWAYS,
    reads=ALL,
)
ALERT = Topic(
    "operator/alert/{alert}",
    alerts.Alert,
    "Alert `{id, kind, level, what, subject, name, remedy, since_ns, until_ns, acked, cleared_ns}`; with `cleared_ns` "
    "it is over",
    inside=("id",),
    writer="the gateway that looks after it, or where it is acknowledged",
    often="when it begins, changes (at most every 10 s), is acknowledged, is over",
    kept="the alert itself is in the DHT",
    puts=GATEWAYS,
    reads=WATCHERS,
)
CLOSURE = Topic(
    "operator/closure/{closure}",
    Closure,
    "Closure `{kind, name, by, rule, until_ns, ended_ns}`: a closed place, a robot in maintenance or a standing rule; "
    "with `ended_ns` it is over",
    writer="the gateway that an operator asks; the record's owner when its time is over",
    often="when it begins, changes, is over",
    kept="the closure itself is in the DHT",
    puts=GATEWAYS,
    reads=WATCHERS,
)
RECORDER_ALIVE = Topic(
    "recorder/{recorder}/alive",
    Untyped,
    form="token",
    writer="that recorder",
    often="while it records",
    kept="gone with its process at once",
    puts=GATEWAYS | {Role.RECORDER},
    reads=WATCHERS,
)
RECORDER_STATUS = Topic(
    "recorder/{recorder}/status",
    recorder_api.RecorderStatus,
    writer="that recorder",
    often="every second",
    kept="by listeners",
    puts=GATEWAYS | {Role.RECORDER},
    reads=WATCHERS,
)
RECORDER_TRIGGER = Topic(
    "recorder/{recorder}/trigger",
    recorder_api.Trigger,
    "Trigger `{reason, by}`",
    writer="anybody",
    often="when something is worth keeping; recorder `every`: all of them",
    kept="in logs",
    puts=STEERING,
    reads=WATCHERS,
)
RECORDER_INCIDENT = Topic(
    "recorder/{recorder}/incident",
    recorder_api.Incident,
    "Incident: what made the recorder keep what it has",
    form="log",
    writer="a recorder",
    kept="only written into logs",
)
RECORDER_GAP = Topic(
    "recorder/{recorder}/gap",
    recorder_api.Gap,
    form="log",
    writer="a recorder",
    kept="only written into logs",
)
RECORDER_DELETED = Topic(
    "recorder/{recorder}/deleted",
    recorder_api.Deletion,
    form="log",
    writer="a recorder",
    kept="only written into logs",
)
RECORDER_LOG = Topic(
    "recorder/{recorder}/log",
    Untyped,
    "foxglove.Log: log lines and notices",
    form="log",
    writer="a recorder",
    kept="only written into logs",
)
RECORDER_VIEW = Topic(
    "recorder/{recorder}/robots/{what}",
    Untyped,
    "`transform`, `location`: foxglove.FrameTransform, LocationFix, made of the states of all robots",
    form="log",
    writer="a recorder",
    kept="only written into logs",
)
REPLAY_CLOCK = Topic(
    "recorder/replay/clock",
    recorder_api.Clock,
    "Clock `{at_ns, rate, paused, ended}`: the time in the log",
    writer="a replay, below the fleet that is played onto",
    often="10 times a second",
    puts=ENGINEERS,
    reads=WATCHERS,
)

# --- The plane's own: records, leases, facts
LEASE_GRANT = Verb(
    "lease_grant",
    plane_api.LeaseAsk,
    plane_api.Granted,
    "grant a lease, for the first time or again to its holder, unless another has it or the fence is not the highest",
    exchange=False,
    asks=GATEWAYS,
    signed=True,
)
LEASE_RELEASE = Verb(
    "lease_release",
    plane_api.LeaseEnd,
    plane_api.Released,
    "the grant of that fence is needed no longer",
    exchange=False,
    asks=GATEWAYS,
    signed=True,
)
DHT_WRITE = Verb(
    "dht_write",
    plane_api.Write,
    plane_api.Written,
    "compare and set at the key's owner: `conflict` if `expected` is not the present version, `refused` by anybody "
    "but the owner",
    exchange=False,
    asks=GATEWAYS,
    signed=True,
)
DHT_READ = Verb(
    "dht_read",
    plane_api.KeyAsk,
    plane_api.Found,
    "the record of a key, from this gateway's shard (also a tombstone: `deleted`). Without one, `unsure` says why "
    "there may be one elsewhere (empty: there is none), `owner` whose the key is in its eyes if not its own",
    exchange=False,
    asks=GATEWAYS,
)
DHT_STORE = Verb(
    "dht_store",
    plane_api.StoreAsk,
    plane_api.Found,
    "replicate: keep this version unless a newer one is here, and say which then",
    exchange=False,
    asks=GATEWAYS,
    signed=True,
)
RECORD_READ = Verb(
    "record_read",
    plane_api.RecordAsk,
    plane_api.Found,
    "a record, through any gateway: from its owner, with `replica` from any gateway that holds a copy, first of all "
    "the one asked; that may be behind",
    exchange=False,
    asks=WATCHERS,
)
RECORD_WRITE = Verb(
    "record_write",
    plane_api.RecordChange,
    plane_api.Written,
    "compare and set, through any gateway",
    exchange=False,
    asks=ENGINEERS,
    signed=True,
)
RECORDS = Verb(
    "records",
    plane_api.RecordsAsk,
    plane_api.RecordList,
    "the copies that this gateway holds, tombstones too, in order of keys, at most 1,000: each Listed `{key, copy, "
    "owner, replicas}`, with the copy's version, size and digest",
    exchange=False,
    asks=WATCHERS,
)
RECORD_PLACE = Verb(
    "record_place",
    plane_api.KeyAsk,
    plane_api.RecordPlace,
    "where a record belongs, and what each replica holds of it",
    exchange=False,
    asks=WATCHERS,
)
FACTS = Verb(
    "facts",
    plane_api.FactsAsk,
    plane_api.Facts,
    "this gateway's own facts, and the robots it knows of; with `all` what it knows of the others too and how old "
    "that is, 1 MiB at a time from the id `after` on",
    exchange=False,
    asks=WATCHERS,
)
MEMBER = Verb(
    "member",
    plane_api.MemberAsk,
    plane_api.Member,
    "whether a gateway of this name is seen: asked by one that joins, so that no id is used twice",
    exchange=False,
    asks=WATCHERS,
)
ROSTER = Verb(
    "roster",
    plane_api.SealedAsk,
    plane_api.SealedTold,
    "compare rosters; the newer one counts, if the authority has signed it",
    exchange=False,
    asks=STEERING,
    signed=True,
)
PARTS = Verb(
    "parts",
    plane_api.SealedAsk,
    plane_api.SealedTold,
    "compare lists of parts; the newer one counts, if the authority has signed it",
    exchange=False,
    asks=ENGINEERS,
    signed=True,
)
REOPENING = Verb(
    "reopening",
    plane_api.ReopeningAsk,
    plane_api.Reopening,
    "a gateway opens its session again, with other keys or for other robots: it counts as there meanwhile",
    timeout_s=1.0,
    exchange=False,
    asks=GATEWAYS,
    signed=True,
)
DHT_DIGEST = Verb(
    "dht_digest",
    plane_api.DigestAsk,
    plane_api.DigestList,
    "which records that the asker should hold are here",
    exchange=False,
    asks=GATEWAYS,
)
DHT_FETCH = Verb(
    "dht_fetch",
    plane_api.FetchAsk,
    plane_api.FetchList,
    "the records of at most 4,000 keys, 2 MiB at a time",
    exchange=False,
    asks=GATEWAYS,
)

# --- Tasks
SUBMIT = Verb(
    "submit",
    TaskRequest,
    TaskRecord,
    "a task, at any gateway; durable on its owner and replicas when answered",
    timeout_s=6.0,
    asks=STEERING,
    signed=True,
)
ACCEPT = Verb(
    "accept",
    TaskRequest,
    TaskRecord,
    "the same, handed on to the owner of the task's key",
    timeout_s=2.0,
    asks=GATEWAYS,
    signed=True,
)
TASK = Verb(
    "task",
    task_api.TaskAsk,
    TaskRecord,
    "one task",
    asks=ALL,
)
TASKS = Verb(
    "tasks",
    task_api.TasksAsk,
    task_api.TaskList,
    "the newest tasks",
    asks=WATCHERS,
)
CANCEL = Verb(
    "cancel",
    task_api.CancelTaskAsk,
    TaskRecord,
    "stop a task",
    asks=STEERING,
    signed=True,
)
CANCEL_HERE = Verb(
    "cancel_here",
    task_api.CancelTaskAsk,
    TaskRecord,
    "the same, at its coordinator",
    asks=GATEWAYS,
    signed=True,
)
WHY = Verb(
    "why",
    task_api.WhyAsk,
    task_api.TaskWhy,
    "what a task waits for and why its subtasks ran where they did: group, candidates, who cannot and why, its place "
    "and when it may start; handed on to its coordinator",
    asks=WATCHERS,
)
TASK_LINES = Verb(
    "task_lines",
    task_api.TaskLinesAsk,
    task_api.TaskLines,
    "what the asked gateway said of a task lately, and what its clock shows: for `swiftbot task watch`",
    asks=WATCHERS,
)
PAUSE = Verb(
    "pause",
    task_api.PauseAsk,
    TaskRecord,
    "start no further subtask",
    asks=STEERING,
    signed=True,
)
RESUME = Verb(
    "resume",
    task_api.ResumeAsk,
    TaskRecord,
    "go on",
    asks=STEERING,
    signed=True,
)
RETRY = Verb(
    "retry",
    task_api.RetryAsk,
    TaskRecord,
    "try again what failed or was cancelled; what has succeeded is kept, attempts count on",
    asks=STEERING,
    signed=True,
)
FIRST = Verb(
    "first",
    task_api.FirstAsk,
    TaskRecord,
    "put a task before others that wait for the same robot; none that has begun is stopped",
    asks=STEERING,
    signed=True,
)
APPROVE = Verb(
    "approve",
    task_api.ApproveAsk,
    TaskRecord,
    "let the plan that waits take effect, or the edited `plan` in its place; durable when answered. `conflict` names "
    "who was faster, or the hash that waits by now; `plan` lists what is wrong with an edited one, and the task waits"
    " on",
    asks=STEERING,
    signed=True,
)
REJECT = Verb(
    "reject",
    task_api.RejectAsk,
    TaskRecord,
    "turn it down: a first plan's task is cancelled, one that waits after a failure fails",
    asks=STEERING,
    signed=True,
)
PLAN_CHECK = Verb(
    "plan_check",
    task_api.PlanCheckAsk,
    task_api.PlanChecked,
    "what is wrong with a plan just now; runs nothing",
    asks=WATCHERS,
)
ANSWER = Verb(
    "answer",
    task_api.AnswerAsk,
    Enquiry,
    "answer a question; the first counts, `conflict` names who gave it",
    asks=STEERING | ROBOTS,
    signed=True,
)
ENQUIRIES = Verb(
    "enquiries",
    task_api.EnquiriesAsk,
    task_api.EnquiryList,
    "questions that wait for an answer; `local`: those whose records are the asked gateway's",
    asks=WATCHERS,
)
ALERTS = Verb(
    "alerts",
    alerts.AlertsAsk,
    alerts.AlertList,
    "what operators have to know of and do something about; `local`: those whose records are the asked gateway's",
    asks=WATCHERS,
)
ALERT_ACK = Verb(
    "alert_ack",
    alerts.AlertAck,
    alerts.AlertsAcked,
    "acknowledge alerts by their ids; the first who does it stands there",
    asks=STEERING,
    signed=True,
)
ACTS = Verb(
    "acts",
    task_api.ActsAsk,
    task_api.ActList,
    "what operators ordered lately, of any gateway, as the asked one has heard",
    asks=WATCHERS,
)

# --- Plans
PLAN = Verb(
    "plan",
    task_api.PlanAsk,
    task_api.PlanAnswer,
    "decompose, run nothing; `private`: ask no other machine. Refused with `retry_after_s` when too many wait",
    timeout_s=60.0,
    asks=STEERING,
)
PROPOSE = Verb(
    "propose",
    planner_api.ProposeAsk,
    planner_api.Proposed,
    "what the local model of that gateway makes of an instruction, unchecked: asked by gateways that have none",
    asks=GATEWAYS,
)
EXPERIENCE = Verb(
    "experience",
    task_api.ExperienceAsk,
    task_api.ExperienceList,
    "how skills have done on robots lately, by the ends of tasks that the gateway has heard, and the thresholds that "
    "follow",
    asks=WATCHERS,
)
LLM_SWAP = Verb(
    "llm_swap",
    planner_api.SwapAsk,
    planner_api.Swapped,
    "plan with another model folder of that gateway; it loads and is tested beside the old one, which goes on when it"
    " fails",
    asks=ENGINEERS,
    signed=True,
)
SKILLS = Verb(
    "skills",
    task_api.SkillsAsk,
    task_api.SkillList,
    "the skills that can be run there; asked once for each `catalogue` that a status names and that is not known",
    timeout_s=2.0,
    asks=WATCHERS,
)
SITE = Verb(
    "site",
    task_api.SiteAsk,
    Site,
    "the map that gives names of places a meaning there: places, obstacles, forbidden areas",
    asks=WATCHERS,
)

# --- Runs, and moving them
RUN = Verb(
    "run",
    RunRequest,
    RunAccepted,
    "run one attempt of a subtask here, in a container that is reserved by this order; the answer has the reasons "
    "(`choice`). With `hops` = 1 only in a ready one",
    asks=GATEWAYS,
    signed=True,
)
RUN_STATUS = Verb(
    "run_status",
    task_api.RunAsk,
    task_api.RunStatus,
    "what became of a run, and how long ago it gave its last sign of life",
    asks=GATEWAYS,
)
RUN_CANCEL = Verb(
    "run_cancel",
    task_api.RunAsk,
    task_api.RunStatus,
    "end a run; answered as `run_status`",
    asks=GATEWAYS,
    signed=True,
)
ARTIFACT = Verb(
    "artifact",
    task_api.ArtifactAsk,
    task_api.ArtifactPiece,
    "a piece of a file that is stored here",
    asks=WATCHERS,
)
ARTIFACT_KEEP = Verb(
    "artifact_keep",
    task_api.ArtifactKeep,
    task_api.ArtifactKept,
    "fetch a file from a gateway that has it, and keep it while its owner's record is needed",
    timeout_s=60.0,
    asks=GATEWAYS,
    signed=True,
)
FIND_CONTAINERS = Verb(
    "find_containers",
    Need,
    task_api.ContainerList,
    "ready containers this gateway knows of; of its own its word counts, of others' what it heard",
    asks=GATEWAYS,
)
MIGRATE = Verb(
    "migrate",
    task_api.MigrateAsk,
    task_api.Migrated,
    "move a subtask's run, to `to` or the closest gateway. Refused with the reason when it cannot be, and it goes on "
    "where it is",
    timeout_s=60.0,
    asks=STEERING,
    signed=True,
)
MIGRATE_HERE = Verb(
    "migrate_here",
    task_api.MigrateAsk,
    task_api.Migrated,
    "the same, at the task's coordinator",
    timeout_s=60.0,
    asks=GATEWAYS,
    signed=True,
)
MIGRATE_CANCEL = Verb(
    "migrate_cancel",
    task_api.MoveAsk,
    task_api.MoveCancelled,
    "call a move off, until its record is written",
    asks=STEERING,
    signed=True,
)
RUN_HOLD = Verb(
    "run_hold",
    task_api.HoldAsk,
    task_api.Held,
    "make a run ready to be moved: no robot command in progress and none begun for `hold_s`, its newest checkpoint "
    "kept",
    asks=GATEWAYS,
    signed=True,
)
RUN_RESUME = Verb(
    "run_resume",
    task_api.RunAsk,
    task_api.RunStatus,
    "the run stays after all",
    timeout_s=2.0,
    asks=GATEWAYS,
    signed=True,
)
RUN_LEAVE = Verb(
    "run_leave",
    task_api.RunAsk,
    task_api.RunStatus,
    "the run was moved: end it, answered when it has ended",
    asks=GATEWAYS,
    signed=True,
)
RUN_RESERVE = Verb(
    "run_reserve",
    RunRequest,
    task_api.Reserved,
    "hold a container for a run that will be moved here, start one if need be; `run` with the same attempt uses it",
    asks=GATEWAYS,
    signed=True,
)
RUN_UNRESERVE = Verb(
    "run_unreserve",
    task_api.RunAsk,
    task_api.RunStatus,
    "the run does not come: its container is given up",
    timeout_s=2.0,
    asks=GATEWAYS,
    signed=True,
)
DRAIN = Verb(
    "drain",
    task_api.DrainAsk,
    task_api.DrainState,
    "give all runs away and take no more; answered at once",
    asks=ENGINEERS,
    signed=True,
)
UNDRAIN = Verb(
    "undrain",
    task_api.UndrainAsk,
    task_api.DrainState,
    "take runs again",
    asks=ENGINEERS,
    signed=True,
)
DRAIN_STATE = Verb(
    "drain_state",
    task_api.DrainStateAsk,
    task_api.DrainState,
    "how far a drain is, and what each run that is left waits for",
    asks=WATCHERS,
)

# --- Places and robots out of use
CLOSE = Verb(
    "close",
    closures.CloseAsk,
    Closure,
    "close a place, take a robot into maintenance or add a standing rule, or change until when",
    asks=STEERING,
    signed=True,
)
REOPEN = Verb(
    "reopen",
    closures.ReopenAsk,
    Closure,
    "open a place, end the maintenance of a robot, or remove a standing rule",
    asks=STEERING,
    signed=True,
)
CLOSURES = Verb(
    "closures",
    closures.ClosuresAsk,
    closures.ClosureList,
    "places and robots out of use, and standing rules; `local`: those whose records are the asked gateway's",
    asks=WATCHERS,
)

# --- Schedules and saved instructions
SCHEDULE_ADD = Verb(
    "schedule_add",
    schedules.ScheduleAdd,
    Schedule,
    "add a schedule of an instruction; durable when answered, and the same again is the same one",
    asks=STEERING,
    signed=True,
)
SCHEDULE_STEER = Verb(
    "schedule_steer",
    schedules.ScheduleSteer,
    Schedule,
    "pause, resume or remove a schedule",
    asks=STEERING,
    signed=True,
)
SCHEDULES = Verb(
    "schedules",
    schedules.SchedulesAsk,
    schedules.ScheduleList,
    "the schedules and when they are due next; `local`: those whose records are the asked gateway's",
    asks=WATCHERS,
)
INSTRUCTION_SAVE = Verb(
    "instruction_save",
    schedules.InstructionSave,
    SavedInstruction,
    "save an instruction with parameters, or replace one",
    asks=STEERING,
    signed=True,
)
INSTRUCTION_REMOVE = Verb(
    "instruction_remove",
    schedules.InstructionRemove,
    SavedInstruction,
    "remove a saved instruction",
    asks=STEERING,
    signed=True,
)
INSTRUCTIONS = Verb(
    "instructions",
    schedules.InstructionsAsk,
    schedules.InstructionList,
    "the saved instructions; `local`: those whose records are the asked gateway's",
    asks=WATCHERS,
)

# --- Federated learning
LEARN_START = Verb(
    "learn_start",
    learn_api.LearnStartAsk,
    RunRecord,
    "begin a run of a recipe; durable when answered. Refused with the key of the recipe that cannot be",
    timeout_s=30.0,
    asks=STEERING,
    signed=True,
)
LEARN_DATA = Verb(
    "learn_data",
    learn_api.LearnDataAsk,
    learn_api.LearnData,
    "what a gateway has of data sets, by their lists: classes and number of items",
    timeout_s=10.0,
    asks=GATEWAYS,
)
LEARN_RUNS = Verb(
    "learn_runs",
    learn_api.LearnRunsAsk,
    learn_api.LearnRuns,
    "the runs whose records are in this gateway's shard",
    asks=WATCHERS,
)
LEARN_SHOW = Verb(
    "learn_show",
    learn_api.LearnShowAsk,
    learn_api.LearnShown,
    "one run, with its open round as that round's coordinator knows it",
    asks=WATCHERS,
)
LEARN_STEER = Verb(
    "learn_steer",
    learn_api.LearnSteerAsk,
    RunRecord,
    "pause, resume or stop a run, exclude a client or include it again, mark a model to be kept, remove a run that has "
    "ended",
    timeout_s=30.0,
    asks=STEERING,
    signed=True,
)
LEARN_EVAL = Verb(
    "learn_eval",
    learn_api.LearnEvalAsk,
    learn_api.LearnEvaluated,
    "evaluate a model that a run keeps on the test part of its data set",
    timeout_s=900.0,
    asks=STEERING,
    signed=True,
)
LEARN_EXPORT = Verb(
    "learn_export",
    learn_api.LearnExportAsk,
    learn_api.LearnExported,
    "write a model that a run keeps as an ONNX file, in a container; the file is kept as long as the model",
    timeout_s=300.0,
    asks=STEERING,
    signed=True,
)
LEARN_KEYS = Verb(
    "learn_keys",
    learn_api.LearnKeysAsk,
    learn_api.LearnKeys,
    "secure aggregation: make keys for clients of this gateway; private ones stay in its memory",
    asks=GATEWAYS,
)
LEARN_SHARE = Verb(
    "learn_share",
    learn_api.LearnShareAsk,
    learn_api.LearnShares,
    "secure aggregation: shares of the secrets of this gateway's clients, each encrypted for one of the cohort",
    timeout_s=30.0,
    asks=GATEWAYS,
)
LEARN_HOLD = Verb(
    "learn_hold",
    learn_api.LearnHoldAsk,
    learn_api.LearnHeld,
    "secure aggregation: the cohort, and the shares of others for this gateway's clients to hold",
    timeout_s=30.0,
    asks=GATEWAYS,
)
LEARN_UNMASK = Verb(
    "learn_unmask",
    learn_api.LearnUnmaskAsk,
    learn_api.LearnUnmasked,
    "secure aggregation: the shares that the sum of some clients' updates needs, given for one set of clients only",
    timeout_s=30.0,
    asks=GATEWAYS,
)

# --- Robots
SOFT_STOP = Verb(
    "soft_stop",
    robot_api.StopAsk,
    robot_api.StopAnswer,
    "robots (none named: the fleet) hold and are given no command until that is lifted. Answered with the gateways "
    "that have it on disk and the robots that hold",
    asks=STOPPING,
    signed=True,
    urgent=True,
)
SOFT_RESUME = Verb(
    "soft_resume",
    robot_api.ResumeRobotsAsk,
    robot_api.StopAnswer,
    "lift soft stops: the `stops` that the operator has seen (none: those known there)",
    asks=STEERING,
    signed=True,
)
STANDING = Verb(
    "standing",
    robot_api.StandingAsk,
    robot_api.Standing,
    "all soft stops and leases known there; takes in what the asker knows, so that both know the same",
    asks=WATCHERS,
    signed=True,
)
CONTROL_TAKE = Verb(
    "control_take",
    robot_api.TakeAsk,
    Lease,
    "take a robot over; `conflict` names who has it",
    asks=STEERING,
    signed=True,
)
CONTROL_RENEW = Verb(
    "control_renew",
    robot_api.RenewAsk,
    Lease,
    "keep it; without a renewal it ends after `lease_s`",
    asks=STEERING,
    signed=True,
)
CONTROL_MOVE = Verb(
    "control_move",
    robot_api.DriveAsk,
    RobotReply,
    "a command under a lease, such as `velocity`",
    asks=STEERING,
    signed=True,
)
CONTROL_GIVE = Verb(
    "control_give",
    robot_api.GiveAsk,
    Lease,
    "give a robot back; it holds",
    asks=STEERING,
    signed=True,
)
ROBOT_LINKS = Verb(
    "robot_links",
    robot_api.LinksAsk,
    robot_api.LinkList,
    "this gateway's MAVLink links and what went over them",
    asks=WATCHERS,
)
ROBOT_LINK_ADD = Verb(
    "robot_link_add",
    robot_api.LinkAdd,
    robot_api.LinkFacts,
    "open a MAVLink link and keep it over restarts; the same again changes nothing",
    asks=ENGINEERS,
    signed=True,
)
ROBOT_LINK_REMOVE = Verb(
    "robot_link_remove",
    robot_api.LinkRemove,
    robot_api.LinkFacts,
    "close a MAVLink link for good",
    timeout_s=15.0,
    asks=ENGINEERS,
    signed=True,
)
ROBOT_FORGET = Verb(
    "robot_forget",
    robot_api.RobotForget,
    robot_api.Forgotten,
    "remove the row of a robot that is offline: its `robot/{robot}/state` is deleted",
    asks=STEERING,
    signed=True,
)

# --- Pools and transfers
POOL_HINT = Verb(
    "pool_hint",
    PoolHint,
    pool_api.Hinted,
    "a plan, by `task`, will need `count` containers here in `in_s`; best effort. The same task and image replaces, a"
    " count of 0 takes back",
    asks=GATEWAYS,
    signed=True,
)
POOL_WARM = Verb(
    "pool_warm",
    pool_api.WarmAsk,
    pool_api.Warmed,
    "have containers ready",
    asks=ENGINEERS,
    signed=True,
)
POOL_EVICT = Verb(
    "pool_evict",
    pool_api.EvictAsk,
    pool_api.Evicted,
    "give up idle containers",
    asks=ENGINEERS,
    signed=True,
)
POOL_RELEASE_QUARANTINE = Verb(
    "pool_release_quarantine",
    pool_api.ReleaseAsk,
    pool_api.Released,
    "start containers again of an image that kept failing",
    asks=ENGINEERS,
    signed=True,
)
POOL_DECISIONS = Verb(
    "pool_decisions",
    pool_api.DecisionsAsk,
    pool_api.DecisionList,
    "which containers were started and given up lately, and why",
    asks=WATCHERS,
)
TRANSFER_MANIFEST = Verb(
    "transfer_manifest",
    transfer_api.ManifestAsk,
    transfer_api.ManifestOffer,
    "what a `volume`, `image` or `blob` (part of an image) is made of; `pending`: ask again, it is being made ready",
    asks=GATEWAYS,
)
IMAGE_FETCH = Verb(
    "image_fetch",
    transfer_api.FetchAsk,
    transfer_api.Brought,
    "have a gateway bring an image to itself, from `gateway` first",
    asks=ENGINEERS,
    signed=True,
)
TRANSFERS = Verb(
    "transfers",
    transfer_api.TransfersAsk,
    transfer_api.TransferList,
    "transfers to that gateway that are under way or wait",
    asks=WATCHERS,
)
TRANSFER_CANCEL = Verb(
    "transfer_cancel",
    transfer_api.CancelAsk,
    transfer_api.Cancelled,
    "end one; what has arrived is kept for the next try",
    asks=ENGINEERS,
    signed=True,
)

# --- records of the DHT that gateways write

TASK_RECORD = RecordKind(
    "task/{task}",
    "TaskRecord; of versions that met after a partition the one that stands, which lists the others (`splits`)",
    writer="the task's coordinator; its owner on the ring, when it is trimmed",
    removed="of the oldest finished ones beyond `tasks.keep_finished` only id, outcome, time, log and a digest of the "
    "request stay (`remembered`), for `tasks.remember_days` and at most `tasks.remember_most`",
)
EFFECT_RECORD = RecordKind(
    "effect/{task}/{subtask}/{number}",
    "whether a handler's call of that number was carried out",
    writer="the executing gateway",
    removed="when its task is trimmed or gone",
)
CHECKPOINT_RECORD = RecordKind(
    "checkpoint/{task}/{subtask}",
    "`{attempt, gateway, at_ns, data, calls}`: what a run saved last, and how many calls it had made, at most "
    "`tasks.max_checkpoint_bytes` = 256 KiB, at most once a second",
    writer="the executing gateway",
    removed="when its task has ended",
)
ENQUIRY_RECORD = RecordKind(
    "ask/{task}/{subtask}/{number}",
    "Enquiry: a handler's question and its answer",
    writer="the executing gateway; the one where it is answered",
    removed="when its task is gone",
)
ALERT_RECORD = RecordKind(
    "alert/{alert}",
    "Alert: what operators have to know of and do something about, who has acknowledged it",
    writer="its owner; of a task the coordinator; the gateway where it is acknowledged",
    removed="when it is over",
)
CLOSURE_RECORD = RecordKind(
    "closure/{closure}",
    "Closure: a place that is closed, a robot in maintenance, or a standing rule; who, why, until when",
    writer="the gateway that an operator asks",
    removed="when it is opened or removed, or its time is over",
)
SCHEDULE_RECORD = RecordKind(
    "schedule/{schedule}",
    "Schedule: an instruction, when it is to be submitted, up to when it is handled, what was missed",
    writer="its owner, which submits its tasks; the gateway that an operator asks",
    removed="90 days after an operator removed it, or when 500 were removed since",
)
INSTRUCTION_RECORD = RecordKind(
    "instruction/{instruction}",
    "SavedInstruction: a text with parameters",
    writer="the gateway that an operator asks",
    removed="when an operator removes it",
)
LEASE_RECORD = RecordKind(
    "lease/{robot}",
    "Lease, of the operator who took the robot over last; `ended` when it is free",
    writer="the gateway that was asked",
    removed="–",
)
VOLUME_RECORD = RecordKind(
    "volume/{volume}",
    "`{name, version, gateway, size_bytes}`: the newest state of a volume",
    writer="the gateway whose run made it",
    removed="–",
)
LEARN_RECORD = RecordKind(
    "learn/{run}",
    "RunRecord of federated learning (`model.learning`): recipe, state, the open round, the model and who holds it, "
    "clients, history; its compare-and-set closes a round. Below it `learn/{run}/{round}`, RoundRecord: base model, "
    "orders, deadline, what counted and by what it closed; `learn/{run}/{round}/{client}`, UpdateRecord: what of a "
    "client counts there, written before it counts",
    writer="the coordinator of the round, the owner of `learn/{run}/{round}`; the gateway that an operator asks",
    removed="a round and its updates with the models that the run keeps no more",
)

VERBS = tuple(cast("Verb[Any, Any]", value) for value in tuple(globals().values()) if isinstance(value, Verb))
TOPICS = tuple(cast("Topic[Any]", value) for value in tuple(globals().values()) if isinstance(value, Topic))
TELEMETRY: tuple[Topic[Any], ...] = (MAVLINK, LINK_FRAMES, CAMERA, ROBOT)
"""What is said so often that the next one says it again: of these a recorder that is overloaded keeps a part."""
RECORD_KINDS = tuple(value for value in tuple(globals().values()) if isinstance(value, RecordKind))


def record_kind(key: str) -> RecordKind | None:
    """Return the kind of a record that gateways write themselves; None for one that is anybody's."""
    return next((kind for kind in RECORD_KINDS if kind.owns(key)), None)


@lru_cache(8192)
def topic_of(key: str) -> Topic[Any] | None:
    """Return the topic that a whole key of any fleet is of; None where it is of none."""
    return next((topic for topic in TOPICS if topic.match(key) is not None), None)


@lru_cache(8192)
def is_telemetry(key: str) -> bool:
    """Whether a whole key is of telemetry."""
    return any(topic.match(key) is not None for topic in TELEMETRY)
