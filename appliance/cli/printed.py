"""What `--json` prints, by command: the types whose schemas are in docs/schemas/commands.

A command of which nothing stands here prints what it is given (`plane get`, `log cat`), figures by their names
(`bench`), or an object of a few words of its own.
"""

from typing import Any

from appliance.cli.fleet import GatewayShown
from appliance.cli.place import PlaceShown
from appliance.cli.releases import BundleShown, ReleaseShown
from appliance.cli.robots import RobotShown
from appliance.deploy.backup import Contents
from appliance.deploy.support import Collected
from appliance.deploy.upgrade import Ended
from appliance.model import Act, ContainerInfo, Enquiry, Lease, RobotWork
from appliance.model.alerts import Alert, AlertsAcked
from appliance.model.closures import Closure
from appliance.model.learn_api import ClientWhy, LearnEvaluated, LearnShown
from appliance.model.learning import Model, RunRecord
from appliance.model.planner_api import Swapped
from appliance.model.robot_api import Forgotten, LinkFacts, LinkList, StopAnswer
from appliance.model.schedules import SavedInstruction, Schedule, ScheduleShown
from appliance.model.task_api import DrainState, ExperienceList, Line, Migrated, PlanAnswer, PlanChecked, TaskWhy
from appliance.model.transfer_api import Brought
from appliance.tasks.views import TaskView

PRINTED: dict[str, Any] = {
    "alerts": list[Alert],
    "alerts ack": AlertsAcked,
    "alerts list": list[Alert],
    "answer": Enquiry,
    "audit": list[Act],
    "backup": Contents,
    "drain": DrainState,
    "fleet": list[GatewayShown],
    "images fetch": Brought,
    "instructions list": list[SavedInstruction],
    "instructions remove": SavedInstruction,
    "instructions save": SavedInstruction,
    "learn eval": LearnEvaluated,
    "learn exclude": RunRecord,
    "learn include": RunRecord,
    "learn list": list[RunRecord],
    "learn mark": RunRecord,
    "learn models": list[Model],
    "learn pause": RunRecord,
    "learn resume": RunRecord,
    "learn show": LearnShown,
    "learn start": RunRecord,
    "learn stop": RunRecord,
    "learn unmark": RunRecord,
    "learn watch": RunRecord,
    "learn why": ClientWhy,
    "llm swap": Swapped,
    "place close": Closure,
    "place list": list[PlaceShown],
    "place open": Closure,
    "plan": PlanAnswer,
    "pool": list[ContainerInfo],
    "pool list": list[ContainerInfo],
    "pool why": TaskWhy,
    "questions": list[Enquiry],
    "release list": list[ReleaseShown],
    "release show": BundleShown,
    "restore": Contents,
    "resume": StopAnswer,
    "robots": list[RobotShown],
    "robots forget": Forgotten,
    "robots links": list[LinkList],
    "robots links add": LinkFacts,
    "robots links list": list[LinkList],
    "robots links remove": LinkFacts,
    "robots list": list[RobotShown],
    "robots maintain": Closure,
    "robots queue": list[RobotWork],
    "robots release": Lease,
    "robots renew": Lease,
    "robots takeover": Lease,
    "rollback": Ended,
    "rules": list[Closure],
    "rules add": Closure,
    "rules list": list[Closure],
    "rules remove": Closure,
    "schedule add": ScheduleShown,
    "schedule list": list[ScheduleShown],
    "schedule pause": Schedule,
    "schedule remove": Schedule,
    "schedule resume": Schedule,
    "schedule show": ScheduleShown,
    "skill-stats": ExperienceList,
    "submit": TaskView,
    "support": Collected,
    "task approve": TaskView,
    "task cancel": TaskView,
    "task check": PlanChecked,
    "task duplicate": TaskView,
    "task export": TaskView,
    "task list": list[TaskView],
    "task migrate": Migrated,
    "task pause": TaskView,
    "task reject": TaskView,
    "task resume": TaskView,
    "task retry": TaskView,
    "task show": TaskView,
    "task watch": Line,
    "task why": TaskWhy,
    "uncordon": DrainState,
    "upgrade": Ended,
}
