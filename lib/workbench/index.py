"""``index.html``: what a run found, the paper's figures beside its own, and the way to every page."""

from __future__ import annotations

import html

from lib.workbench.pages import markdown_html
from lib.workbench.report import format_value, unit_text
from lib.workbench.style import INDEX_CSS, PAGE_CSS

__all__ = ["index_html"]

_STATES = {
    "complete": "complete",
    "running": "running",
    "failed": "a notebook failed",
    "stopped": "stopped before its end",
}


def index_html(run: dict) -> str:
    """The page of a run.

    Parameters
    ----------
    run:
        The content of metrics.json.
    """
    failed = [book for book in run["notebooks"] if book["state"] == "failed"]
    refresh = '<meta http-equiv="refresh" content="10">' if run["state"] == "running" else ""
    parts = [_header(run)]
    if failed:
        parts.append('<pre class="error">' + "\n".join(_failure_line(book) for book in failed) + "</pre>")
    parts += [_comparison(run), _steps(run), _gallery(run), _all_metrics(run), _provenance(run)]
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>microstereo - run of {run["started"][:10]}</title>{refresh}
<style>{PAGE_CSS}{INDEX_CSS}</style></head>
<body><main>
{"".join(parts)}
</main></body></html>
"""


def _header(run: dict) -> str:
    done = sum(book["state"] in ("complete", "failed") for book in run["notebooks"])
    facts = {
        "Started": run["started"].replace("T", " ")[:16],
        "Profile": run["profile"],
        "Notebooks": f"{done} of {len(run['notebooks'])}",
        "Time": _duration(run["seconds"]),
        "Machine": f"{run['machine']['cores']} cores, {run['machine']['gpu'] or 'no GPU'}",
    }
    if run["commit"]:
        facts["Commit"] = run["commit"]["id"][:10] + (" + local changes" if run["commit"]["modified"] else "")
    cells = "".join(f"<span><b>{name}</b>{html.escape(str(value))}</span>" for name, value in facts.items())
    return (
        f'<header><h1>microstereo<span class="badge {run["state"]}">{_STATES[run["state"]]}</span></h1>'
        "<p>Stereo vision for robot-assisted eye surgery: every stage of the paper, worked through by the notebooks "
        'below. Each figure comes from a cell of one of them; <a href="metrics.json">metrics.json</a> holds them '
        f'all.</p><div class="facts">{cells}</div></header>'
    )


def _comparison(run: dict) -> str:
    rows = [metric for metric in run["metrics"] if metric["paper"] is not None]
    if not rows:
        return ""
    body = "".join(
        f"<tr><td>{html.escape(_words(m))}<small>{html.escape(m['note'])}</small></td>"
        f'<td class="number paper">{_with_unit(m["paper"], m["unit"])}</td>'
        f'<td class="number ours">{_with_unit(m["value"], m["unit"])}</td><td>{_link(run, m["notebook"])}</td></tr>'
        for m in rows
    )
    return (
        "<h2>The paper and this run</h2>"
        '<div class="table"><table><tr><th></th><th class="number">Paper</th><th class="number">This run</th>'
        f"<th>From</th></tr>{body}</table></div>"
        '<p class="dim">The paper measured its own recordings, which are not public; this run measured the '
        "simulated or real recordings that its notebooks name.</p>"
    )


def _steps(run: dict) -> str:
    cards = []
    for book in run["notebooks"]:
        picture = next((figure for figure in run["figures"] if figure["notebook"] == book["name"]), None)
        image = f'<img src="{picture["file"]}" alt="" loading="lazy">' if picture else ""
        state = {"complete": _duration(book["seconds"]), "pending": "waiting", "running": "running ..."}
        line = (
            f'<p class="why">{html.escape(_failure_line(book))}</p>'
            if book["state"] == "failed"
            else (f'<p class="dim">{state[book["state"]]}</p>')
        )
        links = ""
        if book["page"]:
            links = f'<p><a href="{book["page"]}">Read</a> &middot; <a href="{book["executed"]}">Notebook</a></p>'
        cards.append(
            f'<div class="step {book["state"]}"><div class="picture">{image}</div><div class="text">'
            f"<h3>{html.escape(book['title'])}</h3>{line}{links}</div></div>"
        )
    return f'<h2>The notebooks</h2><div class="steps">{"".join(cards)}</div>'


def _gallery(run: dict) -> str:
    if not run["figures"]:
        return ""
    figures = "".join(
        f'<figure><a href="{figure["file"]}"><img src="{figure["file"]}" alt="" loading="lazy"></a>'
        f"<figcaption>{markdown_html(figure['caption'])}</figcaption></figure>"
        for figure in run["figures"]
    )
    return f'<h2>Pictures</h2><div class="gallery">{figures}</div>'


def _all_metrics(run: dict) -> str:
    parts = []
    for book in run["notebooks"]:
        metrics = [metric for metric in run["metrics"] if metric["notebook"] == book["name"]]
        if metrics:
            rows = "".join(
                f"<tr><td><code>{html.escape(m['name'])}</code></td>"
                f'<td class="number ours">{_with_unit(m["value"], m["unit"])}</td>'
                f'<td class="note">{html.escape(m["note"])}</td></tr>'
                for m in metrics
            )
            parts.append(
                f"<details><summary>{html.escape(book['title'])} ({len(metrics)})</summary>"
                f'<div class="table"><table>{rows}</table></div></details>'
            )
    return "<h2>Every figure recorded</h2>" + "".join(parts) if parts else ""


def _provenance(run: dict) -> str:
    packages = ", ".join(f"{name} {version}" for name, version in run["versions"].items())
    machine = run["machine"]
    given = "".join(f" -p {name} {value}" for name, value in run["parameters"].items())
    return (
        '<h2>What ran it</h2><p class="dim">'
        f"{html.escape(machine['processor'])}, {machine['cores']} cores, {machine['memory_gb']} GB, "
        f"{html.escape(machine['system'])}.<br>{html.escape(packages)}.<br>"
        f"Again: <code>python3 -m lib run --profile {run['profile']}{html.escape(given)}</code></p>"
    )


def _failure_line(book: dict) -> str:
    return (
        f"{book['name']}: {book['failure']['kind']}"
        + (f" in cell {book['failure']['cell']}" if book["failure"]["cell"] else "")
        + f": {book['failure']['message']}"
    )


def _link(run: dict, name: str) -> str:
    book = next(book for book in run["notebooks"] if book["name"] == name)
    return f'<a href="{book["page"]}">{html.escape(book["title"])}</a>'


def _words(metric: dict) -> str:
    """The metric's name as words, without the unit that stands beside it."""
    return metric["name"].removesuffix(f"_{metric['unit']}").replace("_", " ")


def _with_unit(value: float | None, unit: str) -> str:
    return f"{format_value(value)} {html.escape(unit_text(unit))}".rstrip()


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return ""
    return f"{seconds:.0f} s" if seconds < 100 else f"{int(seconds) // 60} min {int(seconds) % 60:02d} s"
