"""The words everybody shares: plans, task records, containers, gateways, robots, and their wire forms.

All structs are frozen facts; a change makes a new one (`msgspec.structs.replace`). They travel as JSON over
Zenoh and into MCAP; `docs/schemas/` holds the JSON schemas made from them. Times: `*_ns` are Unix
nanoseconds for people and logs, never compared between gateways to decide anything; durations are `*_ms` or
`*_s`, measured on one machine's monotonic clock.
"""

from appliance.model.gateways import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    PoolHint,
    RecorderNote,
    VolumeInfo,
)
from appliance.model.messages import (
    ErrorReply,
    Failure,
    LogLine,
    Notice,
    VersionVector,
    encode,
)
from appliance.model.placement import (
    Choice,
    Considered,
    Need,
    Phase,
    Way,
)
from appliance.model.planner import (
    CacheFigures,
    PlannerStatus,
    SlotStatus,
    TierFigures,
    UpstreamStatus,
)
from appliance.model.plans import (
    MAX_SUBTASKS,
    SPLIT,
    Finding,
    Plan,
    Provenance,
    Severity,
    Subtask,
    Tier,
    TierAttempt,
    Verdict,
    oversize,
    plan_hash,
)
from appliance.model.requests import (
    HIGHEST_PRIORITY,
    LONGEST_DEADLINE_S,
    PLAIN_PRIORITY,
    TaskRequest,
)
from appliance.model.revisions import (
    Dropped,
    Proposal,
    Revision,
    RevisionKind,
)
from appliance.model.robots import (
    Pose,
    RobotCommand,
    RobotInfo,
    RobotLimits,
    RobotReply,
)
from appliance.model.runs import (
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
)
from appliance.model.site import (
    Box,
    Device,
    Door,
    Person,
    Place,
    Site,
    SiteObject,
)
from appliance.model.states import (
    SubtaskState,
    TaskState,
)
from appliance.model.steering import (
    Act,
    Approval,
    Decision,
    Enquiry,
    Lease,
    Lifted,
    Pause,
    Signed,
    SoftStop,
    Word,
)
from appliance.model.tasks import (
    Attempt,
    Group,
    LostRun,
    Split,
    SubtaskRecord,
    TaskRecord,
)

__all__ = [
    "HIGHEST_PRIORITY",
    "LONGEST_DEADLINE_S",
    "MAX_SUBTASKS",
    "PLAIN_PRIORITY",
    "SPLIT",
    "Act",
    "Approval",
    "Attempt",
    "Box",
    "CacheFigures",
    "Choice",
    "Considered",
    "ContainerInfo",
    "ContainerState",
    "Decision",
    "Device",
    "Door",
    "Dropped",
    "Enquiry",
    "ErrorReply",
    "Failure",
    "Finding",
    "GatewayStatus",
    "Group",
    "Lease",
    "Lifted",
    "LogLine",
    "LostRun",
    "Need",
    "Notice",
    "Pause",
    "Person",
    "Phase",
    "Place",
    "Plan",
    "PlannerStatus",
    "PoolHint",
    "Pose",
    "Proposal",
    "Provenance",
    "RecorderNote",
    "Revision",
    "RevisionKind",
    "RobotCommand",
    "RobotInfo",
    "RobotLimits",
    "RobotReply",
    "RunAccepted",
    "RunEvent",
    "RunEventKind",
    "RunRequest",
    "Severity",
    "Signed",
    "Site",
    "SiteObject",
    "SlotStatus",
    "SoftStop",
    "Split",
    "Subtask",
    "SubtaskRecord",
    "SubtaskState",
    "TaskRecord",
    "TaskRequest",
    "TaskState",
    "Tier",
    "TierAttempt",
    "TierFigures",
    "UpstreamStatus",
    "Verdict",
    "VersionVector",
    "VolumeInfo",
    "Way",
    "Word",
    "encode",
    "oversize",
    "plan_hash",
]
