"""Functions with which a notebook states metrics, figures and verdicts; the main job collects them after its execution.

They are stored in the notebook's outputs (metrics and verdicts as JSON, a figure as an image whose metadata hold its name),
so an executed notebook is a complete record of its results.  Outside Jupyter each prints one line.
"""

from __future__ import annotations

import base64
import io
import math
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from jinja2 import Environment, FileSystemLoader

if TYPE_CHECKING:  # importing it would slow the start of every notebook
    from matplotlib.figure import Figure

#: Mime types in a notebook's outputs: a metric (name, value, unit, paper, note) and a `lib.trust.Verdict`, as JSON.
METRIC_MIME, VERDICT_MIME = "application/vnd.microstereo.metric+json", "application/vnd.microstereo.verdict+json"
#: Keys of the outputs' metadata: name and caption of a figure; the reason why a notebook ended before its last cell.
FIGURE_METADATA, STOP_METADATA = "microstereo_figure", "microstereo_stop"
#: The colour of each verdict, from the best to the worst.
VERDICT_COLOURS = {"trustworthy": "#067647", "doubtful": "#b54708", "not trustworthy": "#b42318"}
_TEMPLATES = Environment(loader=FileSystemLoader(Path(__file__).with_name("templates")), autoescape=True)  # compiled once
#: Longest SVG; the many points of a scatter plot take less space as a PNG.
_SVG_CHARACTERS = 200_000
#: Name -> value of the metrics that this kernel recorded; None where a value could not be computed.
RECORDED: dict[str, float | None] = {}


class _End(Exception):
    """Ends a notebook without a traceback."""

    def _render_traceback_(self) -> list[str]:
        return []


_End.__name__ = "SystemExit"  # papermill and JupyterLab treat an error of this name, without a value, as a regular end


def record(name: str, value: float, unit: str, *, paper: float | None = None, note: str = "") -> None:
    """State one number: it is shown as a small row, and collected into the run's ``metrics.json``.

    Args:
        name: Lower-case snake case that starts with the stage, such as ``"calibration_reprojection_px"``.  Stating it again
            in the same notebook replaces the value.
        value: A number; NaN and infinity are stored as null, since JSON cannot represent them.
        unit: ``"px"``, ``"mm"``, ``"um"``, ``"s"``, ``"%"``, ...; ``""`` for a pure number.
        paper: The paper's value in the same unit, if it states one.
        note: What a reader must know to judge the number: the data, the number of samples.
    """
    published = None if paper is None else _number(paper, "paper")
    metric = {"name": _checked_name(name), "value": _number(value, "value"), "unit": unit, "paper": published, "note": note}
    RECORDED[name] = metric["value"]
    ours, theirs = with_unit(metric["value"], unit), "" if paper is None else with_unit(published, unit)
    text = f"{name} = {ours}{f' (paper: {theirs})' if theirs else ''}{f'  # {note}' if note else ''}"
    page = rendered("metric.html", name=name, value=ours, paper=theirs, note=note)
    _publish({METRIC_MIME: metric, "text/html": page, "text/plain": text})


def verdict(found: object) -> None:
    """State a verdict (`lib.trust.Verdict`), shown as a badge with its reasons; the worst verdict of a run counts."""
    content = found.to_json()
    _publish({VERDICT_MIME: content, "text/html": rendered("verdict.html", content=content), "text/plain": str(found)})


def rendered(template: str, **values: object) -> str:
    """HTML from a file of ``templates/``; every value is escaped unless the template marks it as safe."""
    return _TEMPLATES.get_template(template).render(values, colours=VERDICT_COLOURS)


def show(figure: Figure, name: str, caption: str) -> None:
    """Display a matplotlib figure with its caption and close it; it is an SVG if small and without images, else a PNG.

    `name` is as in `record` and names the file in the run's ``figures/``; `caption` is one line: the content, where to look.
    """
    import matplotlib.pyplot as plt

    _checked_name(name)
    text = f"Figure {name}: {caption}"
    try:
        if _in_notebook():
            mime, drawn = _drawn(figure)
            metadata = {FIGURE_METADATA: {"name": name, "caption": caption}, mime: {"alt": caption}}
            _publish({mime: drawn, "text/plain": text}, metadata)
            _publish({"text/html": rendered("caption.html", text=caption), "text/plain": caption})
        else:
            print(text)
    finally:
        plt.close(figure)


def _drawn(figure: Figure) -> tuple[str, str]:
    """Mime type and content of a figure: an SVG of up to `_SVG_CHARACTERS`, or a PNG in base64."""
    if not any(axes.images for axes in figure.axes):
        text = io.StringIO()
        figure.savefig(text, format="svg")
        if text.tell() <= _SVG_CHARACTERS:
            return "image/svg+xml", text.getvalue().replace("<svg ", '<svg style="max-width: 100%; height: auto" ', 1)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return "image/png", base64.b64encode(buffer.getvalue()).decode("ascii")


@contextmanager
def timed(stage: str) -> Iterator[None]:
    """Record the wall-clock time of the block as the metric ``seconds_<stage>``, unless the block raises an error."""
    name = _checked_name(f"seconds_{stage}")
    start = time.perf_counter()
    yield
    record(name, round(time.perf_counter() - start, 4), "s")


def stop(reason: str) -> NoReturn:
    """End the notebook as complete; `reason` states in full sentences what is left out, why, and what to do."""
    _publish({"text/html": rendered("caption.html", text=reason), "text/plain": reason}, {STOP_METADATA: reason})
    raise _End


def format_value(value: float | None) -> str:
    """A number as text: four significant digits, no exponent where none is needed."""
    if value is None:
        return "n/a"
    if isinstance(value, int) or (float(value).is_integer() and abs(value) < 1e7):
        return f"{int(value)}"
    return f"{value:.4g}" if 1e-4 <= abs(value) < 1e7 else f"{value:.3e}"


def with_unit(value: float | None, unit: str) -> str:
    """A number and its unit as text; micrometres are "um" in text, tables and figures alike.

    >>> with_unit(12.3456, "um"), with_unit(2.0, "px^2"), with_unit(None, "")
    ('12.35 um', '2 px²', 'n/a')
    """
    return f"{format_value(value)} {unit.replace('^2', '²')}".rstrip()


def _checked_name(name: str) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9_.]*", name):
        raise ValueError(f"name: {name!r} is not lower-case snake case, such as 'calibration_reprojection_px'.")
    return name


def _number(value: float, argument: str) -> float | int | None:
    try:
        number = value.item() if hasattr(value, "item") else value  # numpy and torch scalars
        number = int(number) if isinstance(number, int) else float(number)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{argument}: one number is needed, got {value!r} ({error}).") from None
    return number if math.isfinite(number) else None


def _in_notebook() -> bool:
    """True in a Jupyter kernel (not in plain Python, nor in terminal IPython)."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and getattr(ipython.get_ipython(), "kernel", None) is not None


def _publish(bundle: dict, metadata: dict | None = None) -> None:
    """Display a bundle of mime types; outside Jupyter print its text."""
    if _in_notebook():
        from IPython.display import display

        display(bundle, metadata=metadata, raw=True)
    else:
        print(bundle["text/plain"])
