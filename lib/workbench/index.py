"""``index.html``: what a run found, the paper's numbers beside its own, and the way to every page."""

import re

from lib import paths
from lib.workbench.execution import Failure
from lib.workbench.pages import markdown_html, render
from lib.workbench.report import VERDICT_COLOURS, format_value, unit_text, verdict_html

__all__ = ["index_html"]

#: The note of a number that was read from a record and not computed in the run.
_RECORDED = re.compile(r"(.*, )?recorded\b")
_STATES = {
    "complete": "complete",
    "running": "running",
    "failed": "a notebook failed",
    "stopped": "stopped before its end",
}


def index_html(run: dict) -> str:
    """The page of a run; every text in it is escaped.

    Args:
        run: The content of metrics.json.
    """
    done = sum(book["state"] in ("complete", "failed") for book in run["notebooks"])
    facts = {
        "Recording": run["parameters"].get("recording") or f"{paths.shown(paths.SHIPPED_RECORDING)}, the one that ships",
        "Started": run["started"].replace("T", " ")[:16],
        "Profile": run["profile"],
        "Notebooks": f"{done} of {len(run['notebooks'])}",
        "Time": _duration(run["seconds"]),
        "Machine": f"{run['machine']['cores']} cores, {run['machine']['gpu'] or 'no GPU'}",
    }
    if run["commit"]:
        facts["Commit"] = run["commit"]["id"][:10] + (" + local changes" if run["commit"]["modified"] else "")
    return render(
        "index.html",
        run=run,
        states=_STATES,
        verdict=verdict_html(run) if run["verdict"] else "",
        colours=VERDICT_COLOURS,
        facts=facts,
        titles={book["name"]: book["title"] for book in run["notebooks"]},
        pages={book["name"]: book["page"] for book in run["notebooks"]},
        recorded=lambda metric: bool(_RECORDED.match(metric["note"])),
        reason=lambda failure: str(Failure(**failure)),
        words=lambda metric: metric["name"].removesuffix(f"_{metric['unit']}").replace("_", " "),
        with_unit=lambda value, unit: f"{format_value(value)} {unit_text(unit)}".rstrip(),
        duration=_duration,
        markdown=markdown_html,
    )


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return ""
    return f"{seconds:.0f} s" if seconds < 100 else f"{int(seconds) // 60} min {int(seconds) % 60:02d} s"
