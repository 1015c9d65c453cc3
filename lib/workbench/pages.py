"""The pages of a run: ``index.html``, and one page of each notebook.  They open without network, equations and all."""

import functools
import html
import json
import re
from collections.abc import Iterator
from pathlib import Path

import nbformat
from jinja2 import Environment, FileSystemLoader
from nbconvert.filters.ansi import ansi2html
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import PythonLexer

from lib import paths
from lib.workbench.execution import Failure
from lib.workbench.report import STOP_METADATA, VERDICT_COLOURS, format_value, unit_text, verdict_html

__all__ = ["PLOTLY_FILE", "equation_svg", "index_html", "markdown_html", "page"]

#: plotly's script lies once beside the pages that show a 3D view.
PLOTLY_FILE = "plotly.min.js"
PLOTLY_MIME = "application/vnd.plotly.v1+json"
WIDGET_MIME = "application/vnd.jupyter.widget-view+json"
WIDGET_STATE = "application/vnd.jupyter.widget-state+json"

#: What the converter does not know, in its own words.
_REWRITES = [
    (re.compile(r"\\operatorname\*\{([^{}]*)\}_\{([^{}]*)\}"), r"\\underset{\2}{\\mathrm{\1}}\\,"),
    (re.compile(r"\\operatorname\*\{([^{}]*)\}_(\w)"), r"\\underset{\2}{\\mathrm{\1}}\\,"),
    (re.compile(r"\\operatorname\*?\{([^{}]*)\}"), r"\\mathrm{\1}\\,"),
    (re.compile(r"\\(begin|end)\{(aligned|gathered|align|equation)\}"), r"\\\1{align*}"),
    (re.compile(r"\\math(bb|cal|bf|rm|sf)\s+(\w)"), r"\\math\1{\2}"),
    (re.compile(r"\\[bB]igg?l\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\left\\lVert "),
    (re.compile(r"\\[bB]igg?r\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\right\\rVert "),
    (re.compile(r"\\[bB]igg?\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\Vert "),
    (re.compile(r"\\tag\{([^{}]*)\}"), r"\\qquad\\mathrm{(\1)}"),
]
#: The note of a number that was read from a record and not computed in the run.
_RECORDED = re.compile(r"(.*, )?recorded\b")
_STATES = {
    "complete": "complete",
    "running": "running",
    "failed": "a notebook failed",
    "stopped": "stopped before its end",
}
_IMAGES = {"image/png": "png", "image/jpeg": "jpeg", "image/gif": "gif"}


@functools.lru_cache(maxsize=4096)
def equation_svg(tex: str, *, display: bool, size_px: float = 17.0) -> str:
    """An equation as inline SVG in HTML, on the line of the text; its TeX is the alternative text.

    TeX that the converter cannot read is shown as it is.
    """
    import ziamath  # not at the top: it takes half a second, and few commands need it
    from ziamath.tex import tex2mml

    text = tex.strip()
    for pattern, replacement in _REWRITES:
        text = pattern.sub(replacement, text)
    try:
        if re.search(r"\\|&#x0005C;", tex2mml(text)):
            raise ValueError("a command that the converter does not know")
        drawn = ziamath.Latex(text, size=size_px, inline=not display)
        picture = drawn.svg()
    except Exception:  # whatever the converter stumbles over: the reader still gets the TeX
        return f'<code class="tex">{html.escape(tex)}</code>'
    label = html.escape(" ".join(tex.split()), quote=True)
    style = "" if display else f' style="vertical-align:{drawn.getyofst():.2f}px"'
    picture = picture.replace("<svg ", f'<svg role="img" aria-label="{label}"{style} ', 1)
    return f'<div class="equation">{picture}</div>' if display else picture


class _Renderer(IPythonRenderer):
    """Markdown as JupyterLab shows it, equations drawn."""

    def block_math(self, body: str) -> str:
        return equation_svg(body, display=True)

    def inline_math(self, body: str) -> str:
        return equation_svg(body, display=False)

    def block_html(self, html: str) -> str:
        # Without a picture to embed it stays as it is: a parser would close a tag that a later block closes.
        return super().block_html(html) if "<img" in html else super(IPythonRenderer, self).block_html(html)

    def latex_environment(self, name: str, body: str) -> str:
        return equation_svg(f"\\begin{{{name}}}{body}\\end{{{name}}}", display=True)


def markdown_html(source: str, *, folder: Path = Path(), attachments: dict | None = None, trusted: bool = True) -> str:
    """Markdown with TeX as HTML; pictures it names, relative to `folder`, are embedded.

    HTML in text that is not `trusted`, such as a caption that names a recording, is escaped.
    """
    renderer = _Renderer(
        escape=not trusted,
        allow_harmful_protocols=trusted,
        embed_images=True,
        path=str(folder),
        attachments=attachments or {},
        exclude_anchor_links=True,
    )
    return MarkdownWithMath(renderer=renderer).render(source)


def _render(template: str, **values: object) -> str:
    """A page from a file of ``templates/``; it escapes every value that it does not call safe."""
    folder = Path(__file__).with_name("templates")
    return Environment(loader=FileSystemLoader(folder), autoescape=True).get_template(template).render(values)


def page(
    executed: Path, *, title: str, folder: Path, verdict: dict, previous: tuple[str, str] | None,
    following: tuple[str, str] | None,
) -> str:  # fmt: skip
    """The HTML of an executed notebook.

    Args:
        folder: Where the notebook's source lies: what its relative pictures are relative to.
        verdict: `verdict` (None: it stated none) and `reasons`, shown on top.
        previous, following: (file, title) of the neighbouring pages.
    """
    notebook = nbformat.read(executed, as_version=4)
    widgets = notebook.metadata.get("widgets", {}).get(WIDGET_STATE, {}).get("state", {})
    return _render(
        "page.html",
        title=title,
        body="\n".join(_cell(cell, folder, widgets) for cell in _until_stop(notebook.cells)),
        verdict=verdict_html(verdict) if verdict["verdict"] else "",
        previous=previous,
        following=following,
        code_css=HtmlFormatter(style="friendly").get_style_defs(".code"),
        plotly='class="plotly-view"',
        plotly_file=PLOTLY_FILE,
    )


def _until_stop(cells: list) -> Iterator:
    """The cells up to the one in which `report.stop` ended the notebook."""
    for cell in cells:
        yield cell
        if any(STOP_METADATA in output.get("metadata", {}) for output in cell.get("outputs", [])):
            return


def _cell(cell, folder: Path, widgets: dict) -> str:
    tags = set(cell.metadata.get("tags", []))
    if "papermill-error-cell-tag" in tags or not cell.source.strip():
        return ""
    if cell.cell_type == "markdown":
        prose = markdown_html(cell.source, folder=folder, attachments=cell.get("attachments"))
        return f'<section class="prose">{prose}</section>'
    if cell.cell_type != "code":
        return f"<pre>{html.escape(cell.source)}</pre>"
    code = highlight(cell.source, PythonLexer(), HtmlFormatter(cssclass="code"))
    if cell.metadata.get("jupyter", {}).get("source_hidden"):
        code = f"<details><summary>Code</summary>{code}</details>"
    if "injected-parameters" in tags:
        code = f'<div class="given">Values given to this run{code}</div>'
    outputs = "".join(_outputs(cell.outputs, widgets))
    return f'<section class="cell">{code}{f"<div class=output>{outputs}</div>" if outputs else ""}</section>'


def _outputs(outputs: list, widgets: dict) -> Iterator[str]:
    for output in outputs:
        if output["output_type"] == "stream":
            text = _settled(output["text"])
            if text.strip():
                yield f'<pre class="{output["name"]}">{ansi2html(text)}</pre>'
        elif output["output_type"] == "error":
            if output["traceback"]:
                yield f'<pre class="error">{ansi2html(chr(10).join(output["traceback"]))}</pre>'
        else:
            yield _rich(output["data"], widgets, output.get("metadata", {}))


def _rich(data: dict, widgets: dict, metadata: dict) -> str:
    """The richest form of one output that needs no network."""
    if WIDGET_MIME in data:
        return _widget(data[WIDGET_MIME]["model_id"], widgets)
    if PLOTLY_MIME in data:
        figure = json.dumps({key: data[PLOTLY_MIME].get(key, {}) for key in ("data", "layout")}).replace("<", "\\u003c")
        return (
            '<div class="plotly-view"></div><script>(f => Plotly.newPlot('
            "document.currentScript.previousElementSibling, f.data, f.layout, {responsive: true}))"
            f"({figure})</script>"
        )
    if "text/html" in data:
        return f'<div class="rich">{data["text/html"]}</div>'
    if "image/svg+xml" in data:
        return data["image/svg+xml"]
    for mime, kind in _IMAGES.items():
        if mime in data:
            alt = html.escape(metadata.get(mime, {}).get("alt", ""), quote=True)
            encoded = data[mime].replace("\n", "")
            return f'<img src="data:image/{kind};base64,{encoded}" alt="{alt}">'
    if "text/markdown" in data:
        return markdown_html(data["text/markdown"], trusted=False)
    if "text/latex" in data:
        return equation_svg(data["text/latex"].strip("$ \n"), display=True)
    return f"<pre>{html.escape(data.get('text/plain', ''))}</pre>"


def _widget(model_id: str, widgets: dict) -> str:
    """An interactive part as a page can show it: what its output area held, and where to find it alive."""
    held = "".join(_outputs(list(_held_outputs(model_id, widgets)), widgets))
    return f'<div class="interactive">{held}<p>Interactive: open the notebook in JupyterLab to move the controls.</p></div>'


def _held_outputs(model_id: str, widgets: dict) -> Iterator[dict]:
    state = widgets.get(model_id, {}).get("state", {})
    yield from state.get("outputs", [])
    for child in state.get("children", []):
        yield from _held_outputs(child.removeprefix("IPY_MODEL_"), widgets)


def _settled(text: str) -> str:
    """A terminal's view of text with carriage returns: of a progress bar only its last state."""
    return "\n".join(line.rstrip("\r").rsplit("\r", 1)[-1] for line in re.sub(r"\x1b\[A", "", text).split("\n"))


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
    return _render(
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
