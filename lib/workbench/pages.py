"""The pages of a run: ``index.html``, and one page of each notebook.  They open without a network; equations are SVG."""

import html
import math
import re
import shlex
import tomllib
from functools import lru_cache, partial
from pathlib import Path

import nbformat
from jinja2 import pass_context
from jinja2.runtime import Context
from nbconvert import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath

from lib import paths
from lib.workbench.execution import Failure, choose_notebooks
from lib.workbench.report import format_value, rendered, with_unit

#: plotly's script, of which one copy lies beside the pages that show a 3D view.
PLOTLY_FILE = "plotly.min.js"
_TEMPLATES = Path(__file__).with_name("templates")
#: Mime types of outputs; a page shows the first one that an output has.
_RICHEST_FIRST = ["application/vnd.plotly.v1+json", "text/html", "application/vnd.jupyter.widget-view+json", "image/svg+xml",
                  "image/png", "image/jpeg", "text/markdown", "text/latex", "text/plain"]  # fmt: skip
#: Finds (level, anchor, text) of a heading to which nbconvert has given an anchor.
_HEADING = re.compile(r'<h([23]) id="([^"]+)">(.*?)<a class="anchor-link"', re.DOTALL)
#: State of a notebook (None: it is not part of the run) -> why a number is missing.
_MISSING = {None: "its notebook was not run", "pending": "not yet", "running": "not yet", "failed": "its notebook failed"}

#: TeX that the converter does not know -> equivalent TeX that it knows.
_REWRITES = [
    (re.compile(r"\\operatorname\*\{([^{}]*)\}_(?:\{([^{}]*)\}|(\w))"), r"\\underset{\2\3}{\\mathrm{\1}}\\,"),
    (re.compile(r"\\operatorname\*?\{([^{}]*)\}"), r"\\mathrm{\1}\\,"),
    (re.compile(r"\\(begin|end)\{(aligned|gathered|align|equation)\}"), r"\\\1{align*}"),
    (re.compile(r"\\math(bb|cal|bf|rm|sf)\s+(\w)"), r"\\math\1{\2}"),
    (re.compile(r"\\[bB]igg?l\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\left\\lVert "),
    (re.compile(r"\\[bB]igg?r\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\right\\rVert "),
    (re.compile(r"\\[bB]igg?\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\Vert "),
    (re.compile(r"\\tag\{([^{}]*)\}"), r"\\qquad\\mathrm{(\1)}"),
]


@lru_cache(maxsize=4096)
def equation_svg(tex: str, *, display: bool) -> str:
    """An equation as inline SVG in HTML, aligned with the line of text; TeX that the converter cannot read stays TeX."""
    import ziamath  # imported here, since it takes half a second and few commands need it
    from ziamath.tex import tex2mml

    text = " ".join(tex.split())  # a line break in \text is a space
    for pattern, replacement in _REWRITES:
        text = pattern.sub(replacement, text)
    try:
        if re.search(r"\\|&#x0005C;", tex2mml(text)):
            raise ValueError("a command that the converter does not know")
        drawn = ziamath.Latex(text, size=17.0, inline=not display)
        picture = drawn.svg().replace(' xmlns="http://www.w3.org/2000/svg"', "")  # else headings show "ns0:"
    except Exception:  # whatever the converter cannot handle is shown as TeX
        return f'<code class="tex">{html.escape(tex)}</code>'
    label = html.escape(" ".join(tex.split()), quote=True)
    style = "" if display else f' style="vertical-align:{drawn.getyofst():.2f}px"'
    picture = picture.replace("<svg ", f'<svg role="img" aria-label="{label}"{style} ', 1)
    return f'<div class="equation">{picture}</div>' if display else picture


class _Renderer(IPythonRenderer):
    """Renders Markdown as JupyterLab does, with equations as SVG."""

    def block_math(self, body: str) -> str:
        return equation_svg(body, display=True)

    def inline_math(self, body: str) -> str:
        return equation_svg(body, display=False)

    def block_html(self, html: str) -> str:
        # HTML without an image to embed stays unchanged, since a parser would close tags that a later block closes.
        return super().block_html(html) if "<img" in html else super(IPythonRenderer, self).block_html(html)

    def latex_environment(self, name: str, body: str) -> str:
        return equation_svg(f"\\begin{{{name}}}{body}\\end{{{name}}}", display=True)


def markdown_html(source: str, *, folder: Path = Path(), attachments: dict | None = None, trusted: bool = True) -> str:
    """Convert Markdown with TeX to HTML.  Images are found relative to `folder`; HTML inside is escaped unless `trusted`."""
    how = {"escape": not trusted, "allow_harmful_protocols": trusted, "embed_images": True, "path": str(folder)}
    return MarkdownWithMath(renderer=_Renderer(attachments=attachments or {}, **how)).render(source)


def page(executed: Path, folder: Path, entry: dict, *, previous: dict | None, following: dict | None) -> str:
    """The HTML of an executed notebook whose source lies in `folder`.

    `entry` is the notebook's entry in metrics.json; `previous` and `following` are the entries of its neighbours.
    """

    @pass_context
    def prose(context: Context, source: str) -> str:
        return markdown_html(source, folder=folder, attachments=context["cell"].get("attachments"))

    untrusted = partial(markdown_html, trusted=False)
    exporter = HTMLExporter(
        template_name="notebook", extra_template_basedirs=[str(_TEMPLATES)],
        filters={"markdown2html": prose, "untrusted_markdown": untrusted, "equation": equation_svg},
        preprocessors=["nbconvert.preprocessors.CoalesceStreamsPreprocessor"],  # keeps the last state of a progress bar
    )  # fmt: skip
    exporter.config.NbConvertBase.display_data_priority = _RICHEST_FIRST
    body, _ = exporter.from_notebook_node(nbformat.read(executed, as_version=4))
    return rendered(
        "page.html", body=body, contents=_HEADING.findall(body), content=entry, previous=previous, following=following,
        plotly_file=PLOTLY_FILE if 'class="plotly-view"' in body else None,
    )  # fmt: skip


def index_html(run: dict) -> str:
    """The page of a run, from the content of its metrics.json; every text in it is escaped."""
    return rendered(
        "index.html", run=run, table=headlines(run), shipped=paths.shown(paths.SHIPPED_RECORDING), quote=shlex.quote,
        books={book["name"]: book for book in run["notebooks"]}, is_recorded=is_recorded, with_unit=with_unit,
        reason=lambda failure: str(Failure(**failure)), markdown=markdown_html, whole=[b.stem for b in choose_notebooks()],
    )  # fmt: skip


def is_recorded(metric: dict) -> bool:
    """True if a metric's note states that it was read from a record and not computed in the run."""
    return bool(re.match(r"(.*, )?recorded\b", metric["note"]))


def headlines(run: dict) -> tuple[list[dict], list[str]]:
    """The rows of the table at the top of index.html, and the names of rows that need a truth that the recording lacks.

    ``templates/headlines.toml`` lists these numbers and their targets; `run` is the content of metrics.json.  A light judges
    the run's number, or the recorded one if a run has too few images.
    """
    metrics, books = ({entry["name"]: entry for entry in run[kind]} for kind in ("metrics", "notebooks"))
    own = bool(run["parameters"].get("recording"))
    rows, left_out = [], []
    for line in tomllib.loads((_TEMPLATES / "headlines.toml").read_text(encoding="utf-8"))["headline"]:
        live = metrics.get(line["name"])
        record = None if own else metrics.get(line.get("recorded"))
        here = bool(live) and live["value"] is not None
        judged = ((record if line.get("judged") == "recorded" else live) or {}).get("value")
        judged = math.nan if judged is None else judged  # no number lies in any range
        if own and (line.get("elsewhere") or (line.get("truth") and not here)):
            left_out += [] if line.get("elsewhere") else [line["words"]]
            continue
        unit, paper = line["unit"], (live or line).get("paper")
        before = run.get("previous", {}).get(line["name"])
        book = books.get(line["notebook"], {"state": None})
        lights = {"met": line["target"], "close": line["close"], "missed": (-math.inf, math.inf)}
        fitting = (light for light, (low, high) in lights.items() if low <= judged <= high)
        rows.append(line | {
            "light": next(fitting, "missing"),
            "target": _range(*line["target"], unit),
            "value": with_unit(live["value"], unit) if here else _MISSING.get(book["state"], f"needs {line['needs']}"),
            "recorded": record and with_unit(record["value"], unit),
            "paper": paper is not None and with_unit(paper, unit),
            "before": before is not None and with_unit(before, unit),
            "from": live or record,
        })  # fmt: skip
    return rows[:8], left_out


def _range(low: float, high: float, unit: str) -> str:
    """A target range and its direction in words."""
    if low == 0:
        return f"at most {with_unit(high, unit)} (lower is better)"
    if high == math.inf or (unit == "%" and high == 100):
        return f"at least {with_unit(low, unit)} (higher is better)"
    return f"{format_value(low)} to {with_unit(high, unit)}"
