"""One channel for all keys of a kind, where the messages themselves say which key they were put on.

Tasks, runs, containers and orders come and go by the thousand, and viewers show a list of all channels of a log. So
what is put on `task/t-1/record` stands on the channel `task/record`, and its key is told by its own `id`
(`Topic.inside`). The channel's metadata say how: the template of the keys, and the fields that stand in its braces, so
a log can be read by whoever knows neither. A message that says something else than its key, or is no JSON, has a
channel of its own key, like all messages in logs of earlier versions. Pure.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import msgspec

from appliance.errors import PayloadError
from appliance.model import keyspace
from appliance.model.keys import ROOT, Template, Topic, fleet_and_rest

TEMPLATE, FIELDS = "template", "fields"
"""Of a channel's metadata: `task/{task}/run/{subtask}`, `task subtask`."""


class Shared:
    """The channel of all keys of a kind in one fleet."""

    def __init__(self, fleet: str, template: str, fields: tuple[str, ...]) -> None:
        self._template = Template(template)
        self._fields = fields
        self._prefix = f"{ROOT}/{fleet}/"
        kept = (chunk for chunk in template.split("/") if not chunk.startswith("{"))
        self.topic = f"{self._prefix}{'/'.join(kept)}"
        self.metadata = {TEMPLATE: template, FIELDS: " ".join(fields)}
        names: Any = msgspec.defstruct("Names", [(name, str) for name in fields])
        self._decoder: msgspec.json.Decoder[Any] = msgspec.json.Decoder(names)

    def key_of(self, payload: bytes) -> str | None:
        """Return the key that a message says it was put on; None where it says none."""
        try:
            names = self._decoder.decode(payload)
            return self._prefix + self._template.key(*(getattr(names, name) for name in self._fields))
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, PayloadError):
            return None


@lru_cache(maxsize=256)
def _shared(fleet: str, template: str, fields: tuple[str, ...]) -> Shared | None:
    # Of a log that somebody else has written, too: what does not go together is no channel of ours.
    if not fields or len(Template(template).fields) != len(fields) or not all(map(str.isidentifier, fields)):
        return None
    return Shared(fleet, template, fields)


def topic_of_kind(fleet: str, topic: Topic[Any]) -> str:
    """Return the name of the channel that all keys of a topic share in a fleet's logs."""
    shared = _shared(fleet, topic.text, topic.inside)
    assert shared is not None, f"keys of {topic.text} share no channel"  # noqa: S101 - a defect of the table
    return shared.topic


def shared_for(key: str, payload: bytes) -> Shared | None:
    """Return the channel that a message of JSON shares with others of its kind; None where it has its key's own."""
    topic = keyspace.topic_of(key)
    if topic is None or not topic.inside:
        return None
    shared = _shared(fleet_and_rest(key)[0], topic.text, topic.inside)
    return shared if shared is not None and shared.key_of(payload) == key else None


def shared_of(topic: str, metadata: Mapping[str, str]) -> Shared | None:
    """Return the shared channel that one of a log is; None for one of a single key."""
    if TEMPLATE not in metadata:
        return None
    shared = _shared(fleet_and_rest(topic)[0], metadata[TEMPLATE], tuple(metadata.get(FIELDS, "").split()))
    return shared if shared is not None and shared.topic == topic else None
