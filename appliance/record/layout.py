"""A layout for Foxglove that shows a fleet as a recorder or the live view gives it: robots, map, log, tasks.

In the form in which Foxglove exports layouts ("Import from file"). Pure.
"""

from typing import Any

from appliance.model import keyspace
from appliance.model.keys import Keys, Topic
from appliance.record.channels import topic_of_kind
from appliance.record.schemas import SITE_FRAME


def layout(fleet: str, recorder: str) -> dict[str, Any]:
    """Return a layout.

    Args:
        fleet: whose log it is for.
        recorder: who writes it; the live view is `live`.

    Raises:
        PayloadError: a name cannot be part of a key.
    """
    keys = Keys(fleet)
    transform, location = (keys(keyspace.RECORDER_VIEW, recorder, what) for what in ("transform", "location"))
    robot = _path(keys, keyspace.ROBOT, "{id==$robot}")
    panels: dict[str, Any] = {
        "3D!site": {"followTf": SITE_FRAME, "topics": {transform: {"visible": True}}, "scene": {"transforms": {}}},
        "map!robots": {"topicColors": {}, "disabledTopics": [], "followTopic": location, "zoomLevel": 18},
        "RosOut!log": {"topicToRender": keys(keyspace.RECORDER_LOG, recorder)},
        "StateTransitions!task": _series(_path(keys, keyspace.TRANSITION, "{task==$task}.kind")),
        "RawMessages!task": {"topicPath": _path(keys, keyspace.TASK_UPDATE, "{id==$task}")},
        "Plot!robot": _series(f"{robot}.battery_percent", f"{robot}.speed_mps"),
    }
    return {
        "configById": panels,
        "globalVariables": {"task": "t-1", "robot": "rover_1"},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split(
            "row",
            _split("column", "3D!site", _split("row", "map!robots", "Plot!robot", 50), 60),
            _split("column", "RosOut!log", _split("column", "StateTransitions!task", "RawMessages!task", 40), 45),
            55,
        ),
    }


def _path(keys: Keys, topic: Topic[Any], rest: str) -> str:
    # In quotes, since a fleet's name may have characters that a message path gives a meaning.
    return f'"{topic_of_kind(keys.fleet, topic)}"{rest}'


def _series(*paths: str) -> dict[str, Any]:
    return {"paths": [{"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in paths]}


def _split(direction: str, first: Any, second: Any, percent: float) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percent}
