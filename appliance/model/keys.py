"""Topics, verbs and record kinds: how keys are made and taken apart. `model.keyspace` is the table of all of them.

Everything is under `swiftbot/{fleet}/`, so fleets on one network never meet. What stands in braces in a template is one
chunk of a key.
"""

import re
from typing import Any, Generic, TypeVar

from msgspec import Struct

from appliance.errors import PayloadError
from appliance.model.roles import Role

Q = TypeVar("Q", bound=Struct)
R = TypeVar("R", bound=Struct)
P = TypeVar("P", bound=Struct)

ROOT = "swiftbot"
_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]{0,62}")
_CHUNK = re.compile(r"[^/*$?#\x00-\x1f\x7f]+")
"""What may be one chunk of a key; Zenoh refuses the rest, or takes it for a wildcard."""
_FIELD = re.compile(r"\{(\w+)\}")


def check_name(name: str, what: str) -> str:
    """Return `name` if it may be the id of a gateway, robot or task in a key; PayloadError otherwise."""
    if not _NAME.fullmatch(name):
        raise PayloadError(
            f"{what} {name[:80]!r} is not a valid name", remedy="use a-z, 0-9, '_', '.', '-'; at most 63"
        )
    return name


class Template:
    """A pattern of keys such as `task/{task}/run/{subtask}`."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.fields = tuple(_FIELD.findall(text))
        """What stands in braces, in order."""
        self._form = _FIELD.sub("{}", text)
        self._pattern = re.compile("([^/]*)".join(re.escape(part) for part in self._form.split("{}")))

    def key(self, *values: str) -> str:
        """Return the key with these chunks; PayloadError for one that cannot be a single chunk, or one too few."""
        if len(values) != len(self.fields):
            raise PayloadError(f"{self.text} has {len(self.fields)} names, not {len(values)}")
        for name, value in zip(self.fields, values, strict=True):
            if not _CHUNK.fullmatch(value):
                raise PayloadError(f"{name} {value[:80]!r} cannot be part of a key", remedy="leave out / * $ ? #")
        return self._form.format(*values)

    def expression(self, *values: str) -> str:
        """Return what matches all keys with these chunks; `*`, and those left out, are any."""
        chosen = (*values, *("*" for _ in self.fields[len(values) :]))
        self.key(*(value for value in chosen if value != "*"), *("x" for value in chosen if value == "*"))
        return self._form.format(*chosen)

    def match(self, key: str) -> tuple[str, ...] | None:
        """Return the chunks that stand in the template's braces; None for a key of another form."""
        found = self._pattern.fullmatch(key)
        return None if found is None else found.groups()


class Untyped(Struct):
    """In place of a payload that is no JSON of one form."""


Roles = frozenset[Role]
NOBODY: Roles = frozenset()


class Topic(Template, Generic[P]):
    """Keys of one kind below `swiftbot/{fleet}/`.

    Which roles do what there is what certificates are held to (`identity.access`); a role that is not named may not. A
    robot is held to its own name besides, where the template has a `{robot}`.

    Args:
        text: template, such as `gw/{gateway}/status`.
        payload: what is put there, as JSON; `Untyped` of bytes, and of JSON of many forms.
        shown: the payload for docs/keyspace.md; empty: the payload's name.
        form: `put`, `query` (asked there), `token` (liveliness), `log` (only written into logs).
        inside: fields of the payload that say what stands in the template's braces, in their order: in logs all keys
            of the topic share one channel (`record.channels`). For what comes and goes; none: each key has its own.
        writer: who may put there or answers there.
        often: how often.
        kept: by whom it is kept.
        puts: roles that put, delete or show a token there.
        reads: roles that subscribe there, or look for tokens.
        answers: roles that answer queries there.
        asks: roles that ask there.
    """

    def __init__(
        self,
        text: str,
        payload: type[P],
        shown: str = "",
        *,
        form: str = "put",
        inside: tuple[str, ...] = (),
        writer: str,
        often: str = "–",
        kept: str = "–",
        puts: Roles = NOBODY,
        reads: Roles = NOBODY,
        answers: Roles = NOBODY,
        asks: Roles = NOBODY,
    ) -> None:
        super().__init__(text)
        self.puts, self.reads, self.answers, self.asks = puts, reads, answers, asks
        self.payload, self.form, self.inside = payload, form, inside
        self.shown = shown or ("–" if issubclass(payload, Untyped) else payload.__name__)
        self.writer, self.often, self.kept = writer, often, kept
        self.kind = "/".join("*" if chunk.startswith("{") else chunk for chunk in text.split("/"))
        """The template with `*` for each name."""
        self._below = re.compile(f"{ROOT}/[^/]+/({self._pattern.pattern})")

    def match(self, key: str) -> tuple[str, ...] | None:
        """Return the names in a whole key of any fleet; None for a key of another topic."""
        found = self._below.fullmatch(key)
        return None if found is None else found.groups()[1:]

    def names(self, key: str) -> tuple[str, ...]:
        """Do the same for a key that is known to be of this topic; PayloadError otherwise."""
        found = self.match(key)
        if found is None:
            raise PayloadError(f"{key[:200]} is no key of {self.text}")
        return found


class Keys:
    """The keys of one fleet."""

    def __init__(self, fleet: str) -> None:
        self.fleet = check_name(fleet, "fleet")
        self.root = f"{ROOT}/{fleet}"
        self.everything = f"{self.root}/**"
        """Matches every key of the fleet; the recorder subscribes to it."""

    def __call__(self, topic: Topic[Any], *names: str) -> str:
        """Return the key of a topic with these names; `*`, and those left out, match all.

        Raises:
            PayloadError: a name cannot be one chunk of a key.
        """
        if "*" in names or len(names) < len(topic.fields):
            return f"{self.root}/{topic.expression(*names)}"
        return f"{self.root}/{topic.key(*names)}"


class Verb(Generic[Q, R]):
    """A request to one gateway: a query on `gw/{gateway}/rpc/{verb}`, JSON in and out.

    Args:
        name: the verb.
        request: what is asked with.
        reply: what is answered.
        meaning: for docs/keyspace.md.
        timeout_s: how long an answer is waited for, where the caller says nothing else.
        exchange: whether what was asked and answered is published (`Exchange`); not for the plane's own traffic, which
            would repeat what is put anyway.
        asks: roles that may ask it; a role that is not named may not.
        signed: whether it has to be signed by one of these, where there are keys: it changes something, or says who
            wants it.
        urgent: whether it is carried out all the same where its signature is missing or not good.
    """

    def __init__(
        self,
        name: str,
        request: type[Q],
        reply: type[R],
        meaning: str,
        *,
        timeout_s: float = 5.0,
        exchange: bool = True,
        asks: Roles = NOBODY,
        signed: bool = False,
        urgent: bool = False,
    ) -> None:
        self.asks, self.signed, self.urgent = asks, signed, urgent
        self.name, self.request, self.reply, self.meaning = name, request, reply, meaning
        self.timeout_s, self.exchange = timeout_s, exchange


class RecordKind(Template):
    """Records of the DHT that gateways write themselves: nobody else changes them, except by force.

    Args:
        text: template of their keys, which are not under the fleet's root.
        value: what they hold.
        writer: which gateway writes them.
        removed: when, and by whom.
    """

    def __init__(self, text: str, value: str, *, writer: str, removed: str) -> None:
        super().__init__(text)
        self.value, self.writer, self.removed = value, writer, removed
        self.prefix = text.partition("{")[0]
        """What all of their keys begin with."""

    def owns(self, key: str) -> bool:
        """Whether a key is one of this kind, or cannot be told from one."""
        return key.startswith(self.prefix)


def fleet_and_rest(key: str) -> tuple[str, str]:
    """Return the fleet of a key and what follows it; no fleet and the key itself of one that is under none."""
    root, _, below = key.partition("/")
    fleet, slash, rest = below.partition("/")
    return (fleet, rest) if root == ROOT and slash else ("", key)
