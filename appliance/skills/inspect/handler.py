"""inspect: look an asset over: what stands out in its picture, whether it can be judged, what changed since last time.

It has no detector of defects: it says what differs from the last inspection and what is coloured, as leaks, rust and
warning lamps are, for a person to look at. The picture is then what the next inspection is compared with.
"""

from functools import partial
from typing import Any

from _lib import baselines, changes, colours, params, pictures
from _lib.context import Context

DARK, BLURRED = 0.08, 2e-5
"""Mean brightness (of 1) and sharpness below which a picture says little."""


def run(ctx: Context) -> dict[str, Any]:
    """Return findings (kind, text, and a box or share), image, asset, judged and compared."""
    asset = params.text(ctx, "asset")
    ctx.progress(0.1, f"looking at {asset}")
    data, about = pictures.take(ctx, asset)
    image = pictures.keep(ctx, asset, data)
    now = changes.small(ctx, data, asset)
    findings: list[dict[str, Any]] = []
    if now.mean() < DARK:
        findings.append({"kind": "dark", "text": f"the picture of {asset} is too dark to judge"})
    if changes.sharpness(now) < BLURRED:
        findings.append({"kind": "blurred", "text": f"the picture of {asset} shows no edges: blurred, or covered"})
    judged = not findings
    picture = colours.decode(ctx, data, asset)
    findings += [
        {"kind": "colour", "text": f"{row['colour']} area", "box": row["box"]}
        for row in colours.detections(picture, "things", ctx.site)
    ]
    name = f"inspect {asset}"
    before = baselines.last(ctx, name, partial(changes.small, ctx, name=asset)) if judged else None
    if before is not None:
        change = changes.between(now, before)
        if change["boxes"]:
            share = 100 * change["changed_share"]
            findings.append({"kind": "changed", "text": f"{share:.0f} % differs from the last inspection", **change})
    if judged:
        baselines.keep(ctx, name, changes.png(now))
    ctx.progress(1.0, f"{asset}: {len(findings)} findings")
    result = {"findings": findings, "image": image, "asset": asset, "judged": judged, "compared": before is not None}
    return {**result, "camera": about}
