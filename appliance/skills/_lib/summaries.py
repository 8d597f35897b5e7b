"""Says in words what earlier subtasks have found; reports and notices are made of it.

It goes by the shape of results, not by the names of skills, so a skill that is added later is reported too.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from . import params, pictures

_MAX_LINES = 40
_MAX_TEXT = 2000
_TOLD = frozenset(
    {"skill", "place", "pose", "path_m", "waypoints", "image", "images", "annotated", "frames", "video", "target",
     "detections", "count", "note", "text", "summary", "number", "object", "at", "notice", "to", "camera"}
)  # fmt: skip
"""Keys that have a sentence of their own."""


def lines(result: Mapping[str, Any]) -> list[str]:
    """Return one sentence for each thing a result says."""
    said = list(_sentences(result))
    for key, value in result.items():
        if key not in _TOLD and isinstance(value, str | int | float | bool) and value != "":
            said.append(f"{key.replace('_', ' ')}: {_short(value)}")
    return said[:_MAX_LINES] or ["done"]


def _sentences(result: Mapping[str, Any]) -> Iterator[str]:
    target = str(result.get("target", "")) or "it"
    if "place" in result:
        yield f"reached {result['place']}" + _metres(result)
    if "object" in result:
        yield f"{'put' if 'at' in result else 'picked'} {result['object']}" + (
            f" at {result['at']}" if "at" in result else ""
        )
    if isinstance(result.get("detections"), list):
        rows = params.rows(result["detections"])
        yield f"{plural(len(rows), 'detection')} of {target}" + (f": {_kinds(rows)}" if rows else "")
    elif isinstance(result.get("number"), int | float):
        yield f"counted {result['number']:g} {target}"
    shots = list(pictures.references([result.get("image"), result.get("images")], "image/"))
    if shots and "detections" not in result:
        yield f"{plural(len(shots), 'picture')} of {target}"
    frames = list(pictures.references(result.get("frames"), "image/"))
    if frames:
        yield plural(len(frames), "frame")
    for video in pictures.references(result.get("video"), "video/"):
        yield f"video {video.get('name', '')} of {target}" + (
            f", {result['duration_s']:g} s" if isinstance(result.get("duration_s"), int | float) else ""
        )
    for key in ("summary", "text", "note"):
        if isinstance(result.get(key), str) and result[key].strip():
            yield _short(result[key])
            break


def overview(inputs: Mapping[str, Mapping[str, Any]]) -> str:
    """Return all inputs as a few sentences, for a notice."""
    parts = [
        f"{_title(identity, result)}: {'; '.join(lines(result)[:4])}"
        for identity, result in inputs.items()
        if result.get("skill") != "notify"
    ]
    return (". ".join(parts) + "." if parts else "The task has come this far; nothing was handed on to report.")[
        :_MAX_TEXT
    ]


def markdown(inputs: Mapping[str, Mapping[str, Any]], *, title: str, head: list[str]) -> str:
    """Return a report in Markdown: a section for each input, its findings, its files."""
    out = [f"# {title}", "", *head, ""]
    for identity, result in inputs.items():
        out += [f"## {_title(identity, result)}", "", *(f"- {line}" for line in lines(result))]
        for row in params.rows(result.get("detections"))[:20]:
            sure = f"confidence {row.get('confidence', 0)}"
            out.append(f"  - {row.get('label', 'something')}, {sure}, box {row.get('box')}")
        files = [*pictures.references(result, "image/"), *pictures.references(result.get("annotated"), "image/")]
        files += list(pictures.references(result, "video/"))
        for each in files[:_MAX_LINES]:
            mark = "!" if str(each.get("media_type", "")).startswith("image/") else ""
            out.append(f"- {mark}[{each.get('name', 'file')}](artifact:{each['artifact']})")
        out.append("")
    if not inputs:
        out += ["Nothing was handed on to report.", ""]
    return "\n".join(out)


def plural(count: int, noun: str) -> str:
    """Return a number with its noun: 1 picture, 2 pictures."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _title(identity: str, result: Mapping[str, Any]) -> str:
    skill = str(result.get("skill", ""))
    return f"{skill.replace('_', ' ')} ({identity})" if skill else identity


def _metres(result: Mapping[str, Any]) -> str:
    metres = result.get("path_m")
    return f" after {metres:.1f} m" if isinstance(metres, int | float) else ""


def _kinds(rows: list[dict[str, Any]]) -> str:
    per: dict[str, int] = {}
    for row in rows:
        label = str(row.get("label", "something"))
        per[label] = per.get(label, 0) + 1
    return ", ".join(f"{count} {label}" for label, count in sorted(per.items()))


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 300 else text[:299] + "…"
