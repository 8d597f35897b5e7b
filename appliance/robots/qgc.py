"""QGroundControl's custom MAVLink actions: a button for each task template.

Format: QGroundControl user guide, "Custom Mavlink Action". QGroundControl sends the command to the active vehicle's
system, at the component named here, which the gateway answers for.
"""

from collections.abc import Sequence

import msgspec

from appliance.robots.settings import Template

ASK, CANCEL = 31_010, 31_011
"""MAV_CMD_USER_1 and MAV_CMD_USER_2, without loading the dialect."""


def actions(templates: Sequence[Template], *, component: int) -> bytes:
    """Return the JSON file with a button for each template, and one that cancels the last task."""
    buttons: list[dict[str, object]] = [
        {
            "label": each.label or each.instruction[:30],
            "description": each.instruction,
            "mavCmd": ASK,
            "compId": component,
            "param1": each.id,
        }
        for each in templates
    ]
    buttons.append(
        {
            "label": "Cancel task",
            "description": "Cancel the task asked for last",
            "mavCmd": CANCEL,
            "compId": component,
        }
    )
    document = {"version": 1, "fileType": "MavlinkActions", "actions": buttons}
    return msgspec.json.format(msgspec.json.encode(document), indent=2) + b"\n"
