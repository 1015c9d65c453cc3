"""lib.workbench.report outside Jupyter; tests/test_workbench.py has what travels in an executed notebook."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from lib.trust import Reason, Verdict
from lib.workbench import report


def test_record_prints_one_line(capsys):
    report.record("calibration_reprojection_px", np.float32(1.23456), "px", paper=2, note="75 frames")
    report.record("landmark_pck", 99.5, "%")
    assert capsys.readouterr().out == (
        "calibration_reprojection_px = 1.235 px (paper: 2 px)  # 75 frames\nlandmark_pck = 99.5 %\n"
    )


def test_a_verdict_of_trust_is_stated(monkeypatch):
    published = []
    monkeypatch.setattr(report, "_publish", lambda bundle, *_: published.append(bundle))
    clock = {"name": "clock", "level": "not trustworthy", "text": "183 ms > 1 ms", "cure": "Give <offset_s>."}
    report.verdict(Verdict((Reason(**clock),)))
    report.verdict(Verdict())
    assert published[0][report.VERDICT_MIME] == {"verdict": "not trustworthy", "reasons": [clock]}
    assert "Give &lt;offset_s&gt;" in published[0]["text/html"]
    assert published[1][report.VERDICT_MIME] == {"verdict": "trustworthy", "reasons": []}


def test_record_takes_the_place_of_a_missing_number(capsys):
    report.record("surface_error_um", float("nan"), "um")
    assert capsys.readouterr().out == "surface_error_um = n/a um\n"


@pytest.mark.parametrize("name", ["Calibration", "calibration error", "", "2nd", "a-b"])
def test_names_are_snake_case(name):
    with pytest.raises(ValueError, match="name: .* is not lower-case snake case"):
        report.record(name, 1.0, "px")


@pytest.mark.parametrize("value", ["many", np.zeros(2), None])
def test_values_are_numbers(value):
    with pytest.raises(ValueError, match="value: one number is needed"):
        report.record("a_px", value, "px")


def test_show_closes_the_figure(capsys):
    figure, _ = plt.subplots()
    report.show(figure, "a_picture", "What it shows.")
    assert not plt.fignum_exists(figure.number)
    assert capsys.readouterr().out == "Figure a_picture: What it shows.\n"


def test_stop_says_why_and_ends(capsys):
    with pytest.raises(Exception, match="^$") as ended:
        report.stop("Nothing was detected.")
    assert type(ended.value).__name__ == "SystemExit" and capsys.readouterr().out == "Nothing was detected.\n"


def test_timed_records_seconds_and_nothing_for_an_error(capsys):
    with report.timed("calibration"):
        pass
    assert capsys.readouterr().out.startswith("seconds_calibration = ")
    with pytest.raises(ZeroDivisionError), report.timed("calibration"):
        _ = 1 / 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (3, "3"),
        (3.0, "3"),
        (0.123456, "0.1235"),
        (1234567.8, "1.235e+06"),
        (1e-7, "1.000e-07"),
        (0.0, "0"),
        (None, "n/a"),
    ],
)
def test_format_value(value, text):
    assert report.format_value(value) == text
