"""The page of a run: what it shows, and that no text of a recording becomes HTML."""

from __future__ import annotations

import re

from lib.workbench.pages import index_html, markdown_html

SCRIPT = "<script>alert(1)</script>"


def run_with(text: str) -> dict:
    """The content of a metrics.json with `text` in every place that data can reach."""
    failure = {"kind": "error", "cell": 3, "message": f"ValueError: recording.toml: unknown key {text!r}"}
    book = {"name": "01_data", "title": text, "seconds": 1.0, "page": "01_data.html", "executed": "01_data.ipynb"}
    book |= {"left_out": text, "verdict": "doubtful"}
    return {
        "state": "failed",
        "profile": "quick",
        "parameters": {"recording": text},
        "started": "2026-01-01T10:00:00+00:00",
        "seconds": 123.0,
        "commit": {"id": "0123456789abcdef", "modified": True},
        "machine": {"system": text, "processor": text, "cores": 2, "memory_gb": 8.0, "gpu": text},
        "versions": {"python": text},
        "verdict": "doubtful",
        "reasons": [{"name": text, "level": "doubtful", "text": text, "cure": text}],
        "notebooks": [book | {"state": "failed", "failure": failure}, book | {"state": "pending", "failure": None}],
        "metrics": [
            {"notebook": "01_data", "name": "a_px", "value": 1.5, "unit": "px", "paper": 2.0, "note": text},
            {"notebook": "01_data", "name": "b_um", "value": None, "unit": text, "paper": None, "note": text},
        ],
        "figures": [{"notebook": "01_data", "name": "f", "file": "figures/f.png", "caption": f"$x < y$ of {text}"}],
    }


def test_text_of_a_recording_is_never_html():
    page = index_html(run_with(SCRIPT))
    assert "<script" not in page and page.count("&lt;script&gt;") >= 12
    assert 'alt="$x &lt; y$ of &lt;script&gt;' in page
    hostile = index_html(run_with('"><img src=x onerror=alert(1)>'))
    assert "<img src=x" not in hostile and not re.search(r'alt="[^"]*"><img src=x', hostile)


def test_what_the_page_shows():
    page = index_html(run_with("eye"))
    assert "a notebook failed" in page and "01_data: error in cell 3: ValueError: recording.toml" in page
    assert "<b>Recording</b>eye" in page
    assert "2 min 03 s" in page and "0123456789 + local changes" in page and "1 of 2" in page
    assert '<td class="number paper">2 px</td>' in page and '<td class="number ours">1.5 px</td>' in page
    assert "n/a" in page and "<svg " in page and "-p recording eye" in page


def test_html_in_untrusted_markdown_is_escaped():
    assert "<script" not in markdown_html(f"**{SCRIPT}** [x](javascript:alert(1))", trusted=False)
    assert "javascript:" not in markdown_html("[x](javascript:alert(1))", trusted=False)
    assert "<em>" in markdown_html("<em>by the author</em>")


def test_recorded_numbers_have_a_column_of_their_own():
    run = run_with("eye")
    run["metrics"].append(run["metrics"][0] | {"name": "c_px", "value": 7.0, "note": "RMS, recorded, 4 seeds"})
    rows = re.findall(r"<tr><td>(?:a|c)<small>.*?</tr>", index_html(run), re.DOTALL)
    cells = [re.findall(r"<td[^>]*>([^<]*)", row)[1:4] for row in rows]
    assert cells == [["2 px", "1.5 px", ""], ["2 px", "", "7 px"]]
    assert index_html(run).count('class="number recorded">7 px') == 2
