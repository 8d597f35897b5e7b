"""Clients that send what they should not: what becomes of an update. Pure.

`flip` and `noise` are seen by their norm; `hidden` turns round what was learned and stays within the bound of norms, so
only a robust rule can tell it.
"""

import hashlib
import math
from collections.abc import Mapping, MutableMapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from appliance.skills._lib.learning import shards
from workshop.bench.learning.cells import client_name

Attack = Literal["flip", "nan", "noise", "hidden"]
FLIP, HIDDEN = -10.0, -2.0
NOISE = 10.0
"""Norm of the noise, in that of the honest update."""


def attackers(kind: str, clients: int) -> dict[str, Attack]:
    """Return the quarter of the clients, the last of them, that attack: mixed, hidden, or none."""
    names = [client_name(number) for number in range(clients - clients // 4, clients)]
    if kind == "none":
        return {}
    if kind == "hidden":
        return dict.fromkeys(names, "hidden")
    kinds: tuple[Attack, ...] = ("flip", "nan", "noise", "flip")
    return {name: kinds[number % len(kinds)] for number, name in enumerate(names)}


def spoiled(
    found: Mapping[str, Any], attack: Attack, files: MutableMapping[str, bytes], *, seed: int
) -> dict[str, Any]:
    """Return manifest and shards of an update as an attacker sends it; its files are added to `files`."""
    manifest = shards.parse_manifest(found["manifest"])
    values = shards.join(manifest, (files[each["artifact"]] for each in found["shards"]))
    if attack == "nan":
        return _with_nan(found, files)
    if attack == "noise":
        rng = np.random.Generator(np.random.Philox(seed))
        noise = {name: rng.standard_normal(each.shape).astype(np.float32) for name, each in values.items()}
        factor = NOISE * _norm(values) / _norm(noise)
        changed = {name: each * np.float32(factor) for name, each in noise.items()}
    else:
        factor = FLIP if attack == "flip" else HIDDEN
        changed = {name: each * np.float32(factor) for name, each in values.items()}
    parts = list(shards.split(changed))
    references = [_put(files, data, each) for (_, data), each in zip(parts, found["shards"], strict=True)]
    return {"manifest": shards.collect(parts, norm=_norm(changed)).to_json(), "shards": references}


def _norm(values: Mapping[str, NDArray[np.float32]]) -> float:
    return math.sqrt(sum(float(np.square(each, dtype=np.float64).sum()) for each in values.values()))


def _put(files: MutableMapping[str, bytes], data: bytes, like: Mapping[str, Any]) -> dict[str, Any]:
    digest = hashlib.sha256(data).hexdigest()
    files[digest] = data
    return {**like, "artifact": digest, "bytes": len(data)}


def _with_nan(found: Mapping[str, Any], files: MutableMapping[str, bytes]) -> dict[str, Any]:
    """Write a NaN over the last value of the first shard, with a manifest that fits it."""
    first = found["shards"][0]
    data = files[first["artifact"]][:-4] + np.float32(np.nan).tobytes()
    reference = _put(files, data, first)
    manifest: dict[str, Any] = {**found["manifest"]}
    listed = [dict(each) for each in manifest["shards"]]
    listed[0]["digest"] = reference["artifact"]
    return {"manifest": manifest | {"shards": listed}, "shards": [reference, *found["shards"][1:]]}
