"""report: write up what the subtasks before have found, as Markdown, and tell whom it is for."""

import time
from typing import Any

from _lib import params, summaries
from _lib.context import Context


def run(ctx: Context) -> dict[str, Any]:
    """Return report (a reference), text (its Markdown, shortened), summary and about."""
    about = params.text(ctx, "about", default="")
    to = params.text(ctx, "to", default="")
    ctx.progress(0.2, f"summing up {summaries.plural(len(ctx.inputs), 'result')}")
    title = f"Report: {about}" if about else "Report"
    head = [f"Site: {ctx.site.get('name', 'unnamed')}. Written {time.strftime('%Y-%m-%d %H:%M', time.gmtime())} UTC."]
    if to:
        head.append(f"For: {to}.")
    text = summaries.markdown(ctx.inputs, title=title, head=head)
    summary = summaries.overview(ctx.inputs)
    reference = ctx.put_artifact("report.md", text.encode(), "text/markdown")
    result: dict[str, Any] = {"report": reference, "text": text[:4000], "summary": summary}
    if about:
        result["about"] = about
    if to:
        ctx.progress(0.8, f"telling {to}")
        ctx.notify(to, f"{title}\n{summary}")
        result["to"] = to
    ctx.progress(1.0, "written")
    return result
