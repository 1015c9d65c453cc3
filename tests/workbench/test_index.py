"""The page of a run: what it shows, and that no text of a recording becomes HTML."""

from __future__ import annotations

import json
import re

import nbformat

from lib import paths
from lib.simulator.families import FAR
from lib.workbench import results
from lib.workbench.command import previous_values
from lib.workbench.pages import headlines, index_html, markdown_html

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
            {"notebook": "01_data", "cell": "01-a", "name": "a_px", "value": 1.5, "unit": "px", "paper": 2.0, "note": text},
            {"notebook": "01_data", "cell": text, "name": "b_um", "value": None, "unit": text, "paper": None, "note": text},
        ],
        "previous": {"a_px": 1.25},
        "download": None,
        "figures": [{"notebook": "01_data", "name": "f", "file": "figures/f.png", "caption": f"$x < y$ of {text}"}],
    }


def test_text_of_a_recording_is_never_html():
    page = index_html(run_with(SCRIPT))
    assert page.count("<script") == 1 and page.count("&lt;script&gt;") >= 12, "the page's own script alone"
    assert 'alt="$x &lt; y$ of &lt;script&gt;' in page
    assert SCRIPT not in page
    hostile = index_html(run_with('"><img src=x onerror=alert(1)>'))
    assert "<img src=x" not in hostile and not re.search(r'alt="[^"]*"><img src=x', hostile)


def test_what_the_page_shows():
    page = index_html(run_with("eye"))
    assert "a notebook failed" in page and "01_data: error in cell 3: ValueError: recording.toml" in page
    assert "<b>Recording</b>eye" in page
    assert "2 min 03 s" in page and "0123456789 + local changes" in page and "1 of 2" in page
    for kind, name, value in ((" ours", "This run", 1.5), ("", "Previous run", 1.25), (" paper", "Paper", 2)):
        assert f'<td class="number{kind}" data-of="{name}">{value} px</td>' in page
    assert 'href="01_data.html#01-a"' in page
    assert "n/a" in page and "<svg " in page
    assert "<code>python3 -m lib run 01_data --profile quick -p recording eye</code>" in page, "what ran, and no more"
    assert "-p recording &#39;my eye&#39;</code>" in index_html(run_with("my eye")), "a shell takes it"


def test_html_in_untrusted_markdown_is_escaped():
    assert "<script" not in markdown_html(f"**{SCRIPT}** [x](javascript:alert(1))", trusted=False)
    assert "javascript:" not in markdown_html("[x](javascript:alert(1))", trusted=False)
    assert "<em>" in markdown_html("<em>by the author</em>")


def test_recorded_numbers_have_a_column_of_their_own():
    run = run_with("eye")
    run["metrics"].append(run["metrics"][0] | {"name": "c_px", "value": 7.0, "note": "RMS, recorded, 4 seeds"})
    rows = re.findall(r'<tr><td class="name"><code>(?:a|c)_<wbr>px</code>.*?</tr>', index_html(run), re.DOTALL)
    cells = [re.findall(r"<td[^>]*>([^<]*)</td>", row)[:4] for row in rows]
    assert cells == [["1.5 px", "1.25 px", "", "2 px"], ["", "", "7 px", "2 px"]]


# --- the main numbers


def metric(name: str, value: float | None, unit: str = "px", note: str = "", paper: float | None = None) -> dict:
    return {"notebook": "02_landmark_detection", "cell": "02-15", "name": name, "value": value, "unit": unit,
            "note": note, "paper": paper}  # fmt: skip


def finished(*metrics: dict, recording: str = "") -> dict:
    run = run_with("eye") | {"metrics": list(metrics), "previous": {}, "figures": []}
    book = run["notebooks"][1] | {"name": "02_landmark_detection", "state": "complete", "page": "02_landmark_detection.html"}
    return run | {"parameters": {"recording": recording} if recording else {}, "notebooks": [book]}


def test_a_main_number_has_its_light_target_and_cell():
    for value, light in ((0.9, "met"), (1.0, "met"), (1.5, "close"), (2.1, "missed")):
        run = finished(metric("landmark_median_error_px", value))
        run["previous"] = {"landmark_median_error_px": 3.0}
        first, *_ = headlines(run)[0]
        assert first["light"] == light and first["target"] == "at most 1 px (lower is better)" and first["before"] == "3 px"
        assert f'<span class="light {light}">{light}</span>' in index_html(run)
        assert '<a href="02_landmark_detection.html#02-15">02</a>' in index_html(run)


def test_what_a_run_lacks_is_said_and_not_invented():
    rows = {row["name"]: row for row in headlines(finished(metric("landmark_median_error_px", None)))[0]}
    assert len(rows) == 8 and {row["light"] for row in rows.values()} == {"missing"}
    assert rows["landmark_median_error_px"]["value"] == "needs labels or a truth"
    assert rows["surface_rms_everywhere_um"]["value"] == "its notebook was not run"
    failed = finished()
    failed["notebooks"][0]["state"] = "failed"
    assert headlines(failed)[0][0]["value"] == "its notebook failed"


def test_a_record_is_never_this_run():
    shipped = metric("landmark_shipped_whole_frames_median_px", 0.4, note="recorded, 4 seeds")
    first, *_ = headlines(finished(shipped))[0]
    assert first["light"] == "missing" and first["recorded"] == "0.4 px" and first["value"] != "0.4 px"


def test_ten_images_of_a_run_do_not_meet_a_target_that_hundreds_miss():
    numbers = metric("landmark_rung_far_pck_0.2", 86.4, "%"), metric("landmark_far_recorded_pck_0.2", 74.0, "%")
    far = headlines(finished(*numbers))[0][-1]
    assert (far["light"], far["value"], far["recorded"]) == ("close", "86.4 %", "74 %")
    assert headlines(finished(numbers[0]))[0][-1]["light"] == "missing", "nothing to judge by"
    images = sum(row["images"] for row in results.read("rungs").rows if row["rung"] in FAR)
    assert f"the recorded number, from {images:.0f} images" in far["words"]


def test_a_recording_without_truth_shows_only_what_needs_none():
    shipped = metric("landmark_shipped_whole_frames_median_px", 0.4, note="recorded, 4 seeds")
    run = finished(shipped, metric("landmark_seen_share", 95.0, "%"),
                   metric("landmark_rung_far_pck_0.2", 5.0, "%"), recording="mine")  # fmt: skip
    rows, left_out = headlines(run)
    assert [row["name"] for row in rows] == [
        "registration_error_3_frames_um", "pipeline_rate_hz", "calibration_reprojection_px", "landmark_seen_share",
    ]  # fmt: skip
    assert not any(row["recorded"] for row in rows) and rows[-1]["light"] == "met"
    assert len(left_out) == 5 and "no truth, so these numbers are not shown" in index_html(run)


def test_the_previous_run_is_of_this_machine_profile_and_parameters(tmp_path):
    now = finished() | {"machine": {"processor": "a", "cores": 2, "gpu": None, "memory_gb": 8.0, "system": "x"}}
    for name, changed, value in (
        ("1", {}, 1.0), ("2", {"started": "2026-01-02"}, 2.0), ("3", {"started": "2026-01-03", "profile": "paper"}, 3.0),
        ("4", {"started": "2026-01-04", "state": "stopped"}, 4.0), ("5", {"machine": now["machine"] | {"cores": 64}}, 5.0),
    ):  # fmt: skip
        (tmp_path / name).mkdir()
        content = now | {"format": "microstereo.metrics", "state": "complete", "started": "2026-01-01"}
        content |= {"metrics": [metric("a_px", value)]} | changed
        (tmp_path / name / "metrics.json").write_text(json.dumps(content), encoding="utf-8")
        if name == "2":
            newest = content | {"started": "2026-01-05"}
    other = {"7": newest | {"started": 5}, "8": newest | {"metrics": [{"title": "a"}]}, "9": newest | {"machine": None},
             "10": {key: value for key, value in newest.items() if key != "machine"}}  # fmt: skip
    for name, content in other.items():  # of other versions
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.json").write_text(json.dumps(content), encoding="utf-8")
    (tmp_path / "6").mkdir()
    (tmp_path / "6" / "metrics.json").write_text("{", encoding="utf-8")
    assert previous_values(tmp_path, now) == {"a_px": 2.0}


def test_the_main_numbers_are_stated_by_their_notebooks():
    everything = run_with("eye") | {"notebooks": [], "metrics": [], "previous": {}, "parameters": {}}
    own = everything | {"parameters": {"recording": "mine"}}
    for row in [*headlines(everything)[0], *headlines(own)[0]]:
        cells = nbformat.read(paths.NOTEBOOKS / f"{row['notebook']}.ipynb", as_version=4).cells
        source = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
        named = re.findall(r'record\(\s*f?"([^"]*)"', source)
        patterns = ["[a-z0-9.]*(?:_[a-z0-9.]+)?".join(map(re.escape, re.split(r"{[^}]*}", name))) for name in named]
        assert any(re.fullmatch(pattern, row["name"]) for pattern in patterns), row["name"]
