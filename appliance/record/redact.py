"""Secrets never reach a log: fields that are named so, and values that are known to be secret.

A log is copied, mailed and opened in other people's tools, so what must stay here is taken out before it is written:
the value of every JSON field whose name says that it is a secret, wherever it stands (in a text that is JSON itself,
too), and every secret that this process was told of (its configuration, its environment), in whatever payload it turns
up. What is taken out is replaced
by `REDACTED`, so that a reader sees that there was something. Raw frames of robots are not looked into by name: they
must stay byte for byte; a known secret is taken out of them too, at the cost of the frame.

Names are compared word by word (`apiKey`, `api_key` and `API-KEY` are the words api, key): `token` is a secret,
`max_tokens` and `token_count` are not.
"""

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any, cast

import msgspec

REDACTED = "[redacted]"
LEAST_SECRET = 6
"""Characters that a value must have to be looked for everywhere: shorter ones would take half of the log with them."""
MOST_SECRETS = 256
"""Values looked for; each costs a search in every message."""

_ALONE = frozenset(
    {"password", "passwd", "passphrase", "passwort", "secret", "secrets", "apikey", "credential", "credentials",
     "authorization", "cookie", "privatekey"}
)  # fmt: skip
_LAST = frozenset({"token", "bearer", "pwd"})
_BEFORE_KEY = frozenset({"api", "private", "signing", "access", "encryption", "auth", "shared", "secret"})
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_SHORT_NAME = 80
_NAME = re.compile(rb'"((?:[^"\\]|\\.){1,120})"\s*:\s*')
_SCALAR = re.compile(rb'"(?:[^"\\]|\\.)*"?|[^,}\]\s]*')
_STRING_OR_BRACKET = re.compile(rb'"(?:[^"\\]|\\.)*"?|[{}\[\]]')
_NO_JSON = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, OverflowError)
_NOTHING = (b"", b'""', b"null", b"false")


def names_a_secret(name: str) -> bool:
    """Whether a field or variable of that name holds a secret."""
    return _known_name(name) if len(name) <= _SHORT_NAME else _by_its_words(name)


def _by_its_words(name: str) -> bool:
    words = [each.lower() for each in _WORD.findall(name)]
    if not words:
        return False
    if not _ALONE.isdisjoint(words) or words[-1] in _LAST:
        return True
    return any(word in ("key", "keys") and before in _BEFORE_KEY for before, word in pairwise(words))


_known_name = lru_cache(4096)(_by_its_words)
"""Messages have the same few names again and again."""


def without_secrets(value: Any) -> Any:
    """Return plain data (dicts, lists, strings, ...) with the values of fields that name a secret replaced."""
    if isinstance(value, dict):
        return {
            key: REDACTED
            if isinstance(key, str) and names_a_secret(key) and inside not in (None, "", False)
            else without_secrets(inside)
            for key, inside in cast("dict[Any, Any]", value).items()
        }
    if isinstance(value, list | tuple):
        return [without_secrets(each) for each in cast("list[Any]", value)]
    if isinstance(value, str) and '"' in value:
        text = value.encode("utf-8", "surrogatepass")
        clean = _emptied(text) if _may_name_one(text) else text
        return value if clean is text else clean.decode("utf-8", "surrogatepass")
    return value


def known_secrets(*tables: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the values in environment and configuration whose names say that they are secret; the longest first."""
    found: set[str] = set()

    def look(value: Any, *, secret: bool) -> None:
        if isinstance(value, Mapping):
            for key, inside in cast("Mapping[Any, Any]", value).items():
                look(inside, secret=secret or (isinstance(key, str) and names_a_secret(key)))
        elif isinstance(value, list | tuple):
            for each in cast("list[Any]", value):
                look(each, secret=secret)
        elif secret and isinstance(value, str) and len(value) >= LEAST_SECRET:
            found.add(value)

    for table in tables:
        look(table, secret=False)
    return tuple(sorted(found, key=lambda each: (-len(each), each))[:MOST_SECRETS])


class Redactor:
    """Takes secrets out of payloads.

    Args:
        secrets: values that must not be in any payload, beside what fields of such names hold.
    """

    def __init__(self, secrets: Iterable[str] = ()) -> None:
        # As they are, and as they stand in JSON, where quotes and control characters are escaped.
        forms = {form for each in secrets for form in (each.encode(), msgspec.json.encode(each)[1:-1])}
        longest_first = sorted(forms, key=lambda each: (-len(each), each))
        self._known = re.compile(b"|".join(map(re.escape, longest_first))) if longest_first else None
        self.count = 0
        """Payloads that had a secret."""

    def text(self, payload: bytes) -> bytes:
        """Return a payload of any kind without the known secrets."""
        if self._known is None or not self._known.search(payload):
            return payload
        self.count += 1
        return self._known.sub(REDACTED.encode(), payload)

    def json(self, payload: bytes) -> bytes:
        """Return a JSON payload without what fields with such names hold, and without the known secrets.

        One without any comes back byte for byte. One that is no JSON is treated as text that may look like it.
        """
        clean = _emptied(payload) if _may_name_one(payload) else payload
        if clean is payload and self._known is not None and b"\\" in payload:
            clean = self._unescaped(payload, self._known)
        if clean is payload:
            return self.text(payload)
        self.count += 1
        return clean if self._known is None else self._known.sub(REDACTED.encode(), clean)

    def _unescaped(self, payload: bytes, known: re.Pattern[bytes]) -> bytes:
        """Return JSON in which known secrets stand as they are looked for; the payload itself where there are none.

        There are many ways to write one text: any letter may be escaped.
        """
        try:
            plain = msgspec.json.encode(msgspec.json.decode(payload))
        except _NO_JSON:
            return payload
        return plain if known.search(plain) else payload


def _emptied(payload: bytes) -> bytes:
    """Return JSON, or what looks like it, without what fields hold whose names say so; itself where there are none."""
    try:
        value = msgspec.json.decode(payload)
        kept = without_secrets(value)
        plain = msgspec.json.encode(kept)
    except _NO_JSON:
        return _blanked(payload)
    if kept != value:
        return plain
    # A name may stand twice in an object, and only the last counts. Where all is written as we write it, none does.
    return payload if plain == payload or _blanked(payload) is payload else plain


def _blanked(payload: bytes) -> bytes:
    """Return text, as far as it is like JSON, with the values of fields replaced that are named as secrets are."""
    out: list[bytes] = []
    at = 0
    for match in _NAME.finditer(payload):
        begin = match.end()
        if match.start() < at or not names_a_secret(_plain(match.group(1))):
            continue
        end = _end_of_value(payload, begin)
        if payload[begin:end] not in _NOTHING:
            out += (payload[at:begin], b'"%s"' % REDACTED.encode())
            at = end
    return b"".join((*out, payload[at:])) if out else payload


def _plain(name: bytes) -> str:
    """Return a name without its escapes."""
    try:
        return msgspec.json.decode(b'"%s"' % name, type=str)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return name.decode("utf-8", "replace")


def _end_of_value(payload: bytes, begin: int) -> int:
    """Return where a value ends that begins there: the end of all, where it is cut off."""
    if payload[begin : begin + 1] not in (b"{", b"["):
        found = _SCALAR.match(payload, begin)
        return found.end() if found else begin
    depth = 0
    for match in _STRING_OR_BRACKET.finditer(payload, begin):
        if match.group() in (b"{", b"["):
            depth += 1
        elif match.group() in (b"}", b"]"):
            depth -= 1
            if not depth:
                return match.end()
    return len(payload)


def _may_name_one(payload: bytes) -> bool:
    """Whether it is worth looking closer. Most messages are asked only this, so it searches for plain bytes."""
    low = payload.lower()
    return (
        b"pass" in low
        or b"secret" in low
        or b"key" in low
        or b"token" in low
        or b"credential" in low
        or b"authoriz" in low
        or b"cookie" in low
        or b"bearer" in low
        or b"pwd" in low
        or b"\\u" in low  # letters of a name may be written so
    )
