"""compare: what differs between pictures, numbers or findings of the subtasks before, or from a baseline kept by name.

With `baseline`, the first comparison keeps what it got under that name, and later ones hold theirs against it.
"""

from functools import partial
from itertools import pairwise
from typing import Any

from _lib import baselines, changes, params, pictures
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return findings (kind, text, numbers of the difference), compared (how many) and baseline."""
    baseline = params.text(ctx, "baseline", default="")
    images = list(pictures.references(ctx.inputs, "image/"))[-pictures.MAX_PICTURES :]
    numbers = [
        (identity, float(result["number"]))
        for identity, result in ctx.inputs.items()
        if isinstance(result.get("number"), int | float) and not isinstance(result.get("number"), bool)
    ]
    ctx.progress(0.2, f"{len(images)} pictures, {len(numbers)} numbers")
    if not images and not numbers:
        raise ctx.Fail("there is nothing to compare", "photograph, measure or count first")
    findings: list[dict[str, Any]] = []
    compared = _with_baseline(ctx, baseline, images, numbers, findings) if baseline else 0
    if not baseline:
        if max(len(images), len(numbers)) < 2:
            raise ctx.Fail("there is one thing only, and no baseline", "name a baseline, or hand on two results")
        compared = _with_each_other(ctx, images, numbers, findings)
    ctx.progress(1.0, f"{len(findings)} differences")
    return {"findings": findings, "compared": compared, "baseline": baseline}


def _with_each_other(
    ctx: Context,
    images: list[pictures.Reference],
    numbers: list[tuple[str, float]],
    findings: list[dict[str, Any]],
) -> int:
    shown = [
        (str(each.get("name", "picture")), changes.small(ctx, ctx.get_artifact(each), "picture")) for each in images
    ]
    for (name, one), (other_name, other) in pairwise(shown):
        _say_change(findings, f"{other_name} from {name}", changes.between(one, other))
    for (name, one), (other_name, other) in pairwise(numbers):
        findings.append(_difference(f"{other_name} from {name}", one, other))
    return max(0, len(shown) - 1) + max(0, len(numbers) - 1)


def _with_baseline(
    ctx: Context,
    baseline: str,
    images: list[pictures.Reference],
    numbers: list[tuple[str, float]],
    findings: list[dict[str, Any]],
) -> int:
    compared = 0
    if images:
        now = changes.small(ctx, ctx.get_artifact(images[-1]), "the picture")
        before = baselines.last(ctx, f"picture {baseline}", partial(changes.small, ctx, name=baseline))
        if before is None:
            baselines.keep(ctx, f"picture {baseline}", changes.png(now))
            findings.append({"kind": "baseline", "text": f"this picture is the baseline {baseline} from now on"})
        else:
            compared += 1
            _say_change(findings, f"from {baseline}", changes.between(before, now))
    if numbers:
        kept = baselines.last(ctx, f"number {baseline}", _number)
        if kept is None:
            baselines.keep(ctx, f"number {baseline}", repr(numbers[-1][1]).encode())
            findings.append({"kind": "baseline", "text": f"this number is the baseline {baseline} from now on"})
        else:
            compared += 1
            findings.append(_difference(f"from {baseline}", kept, numbers[-1][1]))
    return compared


def _number(data: bytes) -> float:
    return float(data)


def _say_change(findings: list[dict[str, Any]], what: str, change: dict[str, Any]) -> None:
    if change["boxes"]:
        text = f"{100 * change['changed_share']:.0f} % of the picture differs {what}"
        findings.append({"kind": "changed", "text": text, **change})


def _difference(what: str, before: float, now: float) -> dict[str, Any]:
    return {
        "kind": "number",
        "text": f"{now:g}, {now - before:+g} {what}",
        "before": before,
        "now": now,
        "difference": round(now - before, 6),
    }
