"""Secrets never reach a log: planted ones are looked for in what is written."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.model import encode, keyspace
from appliance.model.keys import Keys
from appliance.record.models import LoggedMessage
from appliance.record.recorder import Pipeline
from appliance.record.redact import REDACTED, Redactor, known_secrets, names_a_secret, without_secrets
from appliance.record.segments import LogWriter, about
from appliance.record.settings import RecordConfig

KEYS = Keys("f1")
PLANTED = "hunter2-planted-9c1f"


@pytest.mark.parametrize(
    "name",
    ["password", "db_password", "apiKey", "API_KEY", "api-key", "token", "accessToken", "client_secret", "passphrase",
     "Authorization", "signing_key", "private_key_pem", "privateKey", "credentials", "HTTPAuthToken", "pwd"],
)  # fmt: skip
def test_names_of_secrets(name: str) -> None:
    """However it is written, a name that says secret is one."""
    assert names_a_secret(name)


@pytest.mark.parametrize(
    "name", ["key", "keys", "tokens", "max_tokens", "token_count", "monkey", "passenger", "compass", "keyframe", ""]
)
def test_names_of_no_secrets(name: str) -> None:
    """Words that merely look alike are kept: a log without its keys and tokens counted would be none."""
    assert not names_a_secret(name)


def test_fields_are_emptied_wherever_they_stand() -> None:
    """Nested, in lists, of any type; the rest of the message stays; nothing there stays nothing."""
    payload = encode({"a": [{"password": PLANTED, "n": 1}], "token": {"deep": PLANTED}, "secret": None, "key": "k"})
    cleaned = json.loads(Redactor().json(payload))
    assert cleaned == {"a": [{"password": REDACTED, "n": 1}], "token": REDACTED, "secret": None, "key": "k"}


def test_names_written_with_escapes_are_seen() -> None:
    """A name whose letters are written as escapes is the same name."""
    assert PLANTED.encode() not in Redactor().json(b'{"pass\\u0077ord": "%s"}' % PLANTED.encode())


def test_what_is_no_json_is_treated_as_if() -> None:
    """A payload that was cut off, or never was JSON, loses its secrets all the same."""
    assert PLANTED.encode() not in Redactor().json(b'{"n": 1, "password": "%s", "x": [' % PLANTED.encode())
    assert PLANTED.encode() not in Redactor([PLANTED]).json(b"\xff" + PLANTED.encode())


@pytest.mark.parametrize(
    "payload",
    [
        b'{"password": "%s", "password": null}',
        b'{"a": {"token": "%s"}, "a": 1}',
        b'{"battery": NaN, "api_key": {"value": "%s"}}',
        b'{"battery": NaN, "secrets": ["x", "%s"]}',
        b'{"battery": NaN, "pass\\u0077ord": "%s"}',
        b'{"secrets": ["x", {"y": "%s"',
        b'{"arguments": "{\\"password\\": \\"%s\\", \\"n\\": 1}"}',
        b'{"said": ["{\\"inner\\": \\"{\\\\\\"api_key\\\\\\": \\\\\\"%s\\\\\\"}\\"}"]}',
    ],
    ids=[
        "name twice",
        "object twice",
        "object in NaN",
        "list in NaN",
        "escaped in NaN",
        "cut off",
        "in text",
        "in text in text",
    ],
)
def test_fields_that_hide(payload: bytes) -> None:
    """Said twice in one object, nested where it is no JSON, or as JSON in a text of JSON: emptied all the same."""
    redactor = Redactor()
    assert PLANTED.encode() not in redactor.json(payload % PLANTED.encode())
    assert redactor.count == 1


@pytest.mark.parametrize("secret", ["pässwörter-und-mehr", "abc/def+ghi/jkl==", "line\nbreak\ttab", "<a&b>'c\u2028d"])
@pytest.mark.parametrize(
    "written",
    [
        lambda text: json.dumps({"said": f"it is {text}!"}).encode(),
        lambda text: json.dumps({"said": f"it is {text}!"}, ensure_ascii=False).encode(),
        lambda text: json.dumps({"said": f"it is {text}!"}).replace("/", "\\/").encode(),
        lambda text: ('{"said":"' + "".join(f"\\u{ord(each):04X}" for each in text) + '"}').encode(),
    ],
    ids=["ASCII", "UTF-8", "slashes", "all escaped"],
)
def test_known_secrets_however_they_are_written(secret: str, written: Callable[[str], bytes]) -> None:
    """JSON has many ways to write one text; a known secret is seen in each."""
    cleaned = Redactor([secret]).json(written(secret))
    assert secret not in json.loads(cleaned)["said"]
    assert REDACTED in json.loads(cleaned)["said"]


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner, max_size=4),
    max_leaves=12,
)


@given(json_values, st.sampled_from(["password", "apiKey", "session_token"]))
def test_planted_anywhere(value: Any, name: str) -> None:
    """A planted secret is gone from wherever it is, and a message without any comes back byte for byte."""
    redactor = Redactor()
    assert PLANTED.encode() not in redactor.json(encode({"before": value, name: PLANTED, "after": [{name: PLANTED}]}))
    plain = encode({"value": value})
    if json.loads(plain) == without_secrets(json.loads(plain)):
        assert redactor.json(plain) is plain


def test_known_secrets_of_environment_and_configuration() -> None:
    """Only what is named so, and long enough to be looked for; nested tables too."""
    found = known_secrets(
        {"API_TOKEN": PLANTED, "HOME": "/home/somebody", "PASSWORD": "abc"}, {"x": {"secret": "s" * 9}}
    )
    assert set(found) == {PLANTED, "s" * 9}


def test_no_planted_secret_is_in_the_file(tmp_path: Path) -> None:
    """Planted in configuration, key file, environment, fields, free text and frames: none is in the file's bytes."""
    (tmp_path / "key").write_text("file-secret-51c0\n")
    configuration = {
        "id": "gw-1",
        "llm": {"upstream_key_file": str(tmp_path / "key"), "password": "conf-secret-77aa"},
        "robots": {"mavlink": [{"listen": "udp://127.0.0.1:1", "signing": "credential:mavlink"}]},
    }
    told = about(configuration, {"MY_API_KEY": "env-secret-19be", "PATH": "/bin"})
    config = RecordConfig(directory=str(tmp_path / "log"), free_bytes=0, compression="none")
    writer = LogWriter(config, fleet="f1", attached=told.attached)
    writer.prepare()
    pipeline = Pipeline(config, fleet="f1", writer=writer, secrets=told.secrets)
    for key, payload in (
        (KEYS(keyspace.LOG, "g1"), encode({"event": "x", "fields": {"apiToken": PLANTED, "said": "env-secret-19be!"}})),
        (
            KEYS(keyspace.EXCHANGE, "g1", "submit"),
            encode({"request": {"instruction": "say file-secret-51c0", "password": PLANTED}}),
        ),
        (KEYS(keyspace.MAVLINK, "r1", "rx"), b"\xfd" + b"x" * 12 + b"conf-secret-77aa"),
        (KEYS(keyspace.NOTICE, "ops"), b'{"password": "' + PLANTED.encode()),
    ):
        pipeline.write(LoggedMessage(key, 5, payload, "application/json"))
    writer.close()
    data = b"".join(path.read_bytes() for path in (tmp_path / "log").iterdir())
    for secret in (PLANTED, "file-secret-51c0", "conf-secret-77aa", "env-secret-19be"):
        assert secret.encode() not in data
    assert b"configuration.json" in data
    assert b"credential:mavlink" in data
    assert pipeline.redactor.count == 4
