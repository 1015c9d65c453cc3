"""The verdict of a run in at most eight numbers, each with its target; which ones is said in ``templates/headlines.toml``."""

import contextlib
import json
import math
import re
import tomllib
from pathlib import Path

from lib.workbench.report import format_value, with_unit

__all__ = ["complete_runs", "headlines", "is_recorded", "previous_values"]

#: The note of a number that was read from a record and not computed in the run.
_RECORDED = re.compile(r"(.*, )?recorded\b")
#: Metrics of two runs are compared if these entries are the same.
_SAME = ("profile", "parameters")
#: State of the notebook -> why it did not state a number; None: it is not part of the run.
_MISSING = {None: "its notebook was not run", "pending": "not yet", "running": "not yet", "failed": "its notebook failed"}


def is_recorded(metric: dict) -> bool:
    """Whether a metric was read from a record."""
    return bool(_RECORDED.match(metric["note"]))


def complete_runs(runs: Path) -> list[tuple[Path, dict]]:
    """The folders of complete runs in `runs` with their metrics.json, the last run last."""
    found = []
    for file in runs.glob("*/metrics.json"):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # another version's, or cut off
            content = json.loads(file.read_text(encoding="utf-8"))
            if (content["format"], content["state"]) == ("microstereo.metrics", "complete"):
                found.append((content["started"], file.parent, content))
    return [entry[1:] for entry in sorted(found, key=lambda entry: entry[0])]


def previous_values(runs: Path, content: dict) -> dict[str, float | None]:
    """What this machine computed before: metric -> its value in the last complete run that has it.

    Args:
        runs: Where the folders of runs lie.
        content: The metrics.json of this run; only runs with its profile and parameters are taken.
    """
    found = {}
    for _, other in complete_runs(runs):
        here = {key: other["machine"][key] for key in ("processor", "cores", "gpu")}
        if all(other[key] == content[key] for key in _SAME) and here.items() <= content["machine"].items():
            found |= {m["name"]: m["value"] for m in other["metrics"] if not is_recorded(m)}
    return found


def headlines(run: dict) -> tuple[list[dict], list[str]]:
    """The rows of the table on top of index.html, and what has no row because the user's recording has no truth.

    Args:
        run: The content of metrics.json.
    """
    text = (Path(__file__).with_name("templates") / "headlines.toml").read_text(encoding="utf-8")
    metrics, books = ({entry["name"]: entry for entry in run[kind]} for kind in ("metrics", "notebooks"))
    own = bool(run["parameters"].get("recording"))
    rows, left_out = [], []
    for line in tomllib.loads(text)["headline"]:
        live, record = metrics.get(line["name"]), None if own else metrics.get(line.get("recorded"))
        here = bool(live) and live["value"] is not None
        if own and (line.get("elsewhere") or (line.get("truth") and not here)):
            left_out += [] if line.get("elsewhere") else [line["words"]]
            continue
        unit, paper = line["unit"], (live or line).get("paper")
        before, book = run.get("previous", {}).get(line["name"]), books.get(line["notebook"], {"state": None})
        rows.append(line | {
            "light": _light(live["value"], line) if here else "missing",
            "target": _range(*line["target"], unit),
            "value": with_unit(live["value"], unit) if here else _MISSING.get(book["state"], f"needs {line['needs']}"),
            "recorded": record and with_unit(record["value"], unit),
            "paper": paper is not None and with_unit(paper, unit),
            "before": before is not None and with_unit(before, unit),
            "from": live or record,
        })  # fmt: skip
    return rows[:8], left_out


def _light(value: float, line: dict) -> str:
    inside = {name: line[name][0] <= value <= line[name][1] for name in ("target", "close")}
    return "met" if inside["target"] else "close" if inside["close"] else "missed"


def _range(low: float, high: float, unit: str) -> str:
    """A target and its direction in words."""
    if low == 0:
        return f"at most {with_unit(high, unit)} (lower is better)"
    if high == math.inf or (unit == "%" and high == 100):
        return f"at least {with_unit(low, unit)} (higher is better)"
    return f"{format_value(low)} to {with_unit(high, unit)}"
