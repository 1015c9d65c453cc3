"""The main job on tiny notebooks, one for each way to fail."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
import numpy as np
import psutil
import pytest

from lib import paths
from lib.__main__ import COMMANDS
from lib.workbench import command
from lib.workbench.command import run
from lib.workbench.execution import ALONE, Failure, Places, choose_notebooks, execute

GOOD = [
    "from lib.workbench import report\nimport matplotlib.pyplot as plt",
    'report.record("calibration_reprojection_px", 1.5 + seed, "px", paper=2.0, note="of <b>75</b> frames")\n'
    'report.record("landmark_pck", float("nan"), "%")',
    "fig, ax = plt.subplots(figsize=(2, 1)); ax.imshow([[1, 2]])\n"
    'report.show(fig, "calibration_residuals", "Small everywhere.")\n'
    'fig, ax = plt.subplots(figsize=(2, 1)); ax.plot([1, 2]); report.show(fig, "calibration_line", "A line.")',
    'with report.timed("calibration"): pass\nprint(profile)',
    "from types import SimpleNamespace\n"  # as lib.trust.Verdict, which takes seconds to import
    'clock = {"name": "clock", "level": "not trustworthy", "text": "183 ms > 1 ms", "cure": "Give <offset_s>."}\n'
    'report.verdict(SimpleNamespace(to_json=lambda: {"verdict": "not trustworthy", "reasons": [clock]}))',
    'report.verdict(SimpleNamespace(to_json=lambda: {"verdict": "trustworthy", "reasons": []}))',
    "import plotly.graph_objects as go\ngo.Figure(go.Scatter(x=[1], y=[2]))",
    "import ipywidgets\nipywidgets.IntSlider()",
]

main, main_site = COMMANDS["run"], COMMANDS["site"]
ENDED = ["from lib.workbench import report\nreport.stop('No distances, because <i>nothing</i> was detected.')", "1 / 0"]


@pytest.fixture(scope="module")
def books(write_notebook, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("notebooks")
    write_notebook(folder, "00_error", "1 / 0", "print('never')", title="It fails")
    write_notebook(folder, "02_dead", "import os; os.kill(os.getpid(), 9)")
    write_notebook(folder, "03_good", *GOOD, title="It <works>")
    write_notebook(folder, "04_ended", *ENDED)
    return folder


@pytest.fixture(scope="module")
def finished(books, tmp_path_factory) -> tuple[dict, Path]:
    """One run of them all, (metrics.json, folder)."""
    runs = tmp_path_factory.mktemp("runs")
    content = run(pairs=[("seed", "3")], cell_timeout_s=60, runs=runs, notebooks=books)
    (folder,) = runs.iterdir()
    assert content == json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return content, folder


# --- each way to fail


def failure(finished, name: str) -> dict:
    return next(book for book in finished[0]["notebooks"] if book["name"] == name)["failure"]


def test_an_error_is_told_with_its_cell(finished):
    assert failure(finished, "00_error") == {
        "kind": "error", "cell": 3, "message": "ZeroDivisionError: division by zero"
    }  # fmt: skip


@pytest.mark.parametrize("deaths", [1, 2])
def test_a_kernel_that_dies_before_its_first_cell_is_started_once_more(write_notebook, tmp_path, monkeypatch, deaths):
    """Of kernels that start at once, one may find its ports taken."""
    import papermill

    calls = []

    def started(*_, **__):
        calls.append(1)
        if len(calls) <= deaths:
            raise RuntimeError("Kernel died before replying to kernel_info")

    monkeypatch.setattr(papermill, "execute_notebook", started)
    failure = execute(write_notebook(tmp_path, "book", "1"), tmp_path / "executed.ipynb", {})
    assert len(calls) == 2 and (failure is None) == (deaths == 1)


def test_a_timeout_is_detected(write_notebook, tmp_path):
    """papermill calls the cell completed."""
    slow = write_notebook(tmp_path, "00_slow", "import time; time.sleep(300)")
    failure = execute(slow, tmp_path / "executed.ipynb", {}, cell_timeout_s=1)
    assert failure.kind == "timeout" and failure.cell == 3


def test_a_dead_kernel_is_told(finished):
    assert failure(finished, "02_dead")["kind"] == "dead kernel" and failure(finished, "02_dead")["cell"] == 3


def test_the_others_still_run(finished):
    content, _ = finished
    assert content["state"] == "failed"
    assert [book["state"] for book in content["notebooks"]] == ["failed", "failed", "complete", "complete"]


def test_a_notebook_that_is_no_json_fails_before_anything_runs(tmp_path):
    (tmp_path / "00_torn.ipynb").write_text('{"cells": [', encoding="utf-8")
    with pytest.raises(ValueError, match="00_torn.ipynb: not a notebook"):
        run(runs=tmp_path / "runs", notebooks=tmp_path)
    assert not (tmp_path / "runs").exists()


def test_a_notebook_that_stops_itself_is_complete_and_says_why(finished):
    content, folder = finished
    (entry,) = (book for book in content["notebooks"] if book["name"] == "04_ended")
    assert entry["state"] == "complete" and entry["left_out"] == "No distances, because <i>nothing</i> was detected."
    page = (folder / entry["page"]).read_text(encoding="utf-8")
    assert "because &lt;i&gt;nothing" in page and "error" not in page.split("</style>")[-1]
    assert '<span class="mi">1</span> <span class="o">/' not in page, "what was left out is not shown"
    assert "because &lt;i&gt;nothing" in (folder / "index.html").read_text(encoding="utf-8")


# --- what a run leaves


def test_metrics_follow_the_schema(finished):
    content, _ = finished
    assert set(content) == {"format", "version", "state", "profile", "parameters", "started", "seconds", "commit",
                            "machine", "weights", "versions", "verdict", "reasons", "notebooks", "metrics", "figures",
                            "previous", "download"}  # fmt: skip
    assert content["format"] == "microstereo.metrics" and content["parameters"] == {"seed": "3"}
    assert content["metrics"][0] == {
        "notebook": "03_good", "name": "calibration_reprojection_px", "value": 4.5, "unit": "px", "paper": 2.0,
        "note": "of <b>75</b> frames", "cell": content["metrics"][0]["cell"],
    }  # fmt: skip
    assert [m["name"] for m in content["metrics"][1:]] == ["landmark_pck", "seconds_calibration"]
    assert content["metrics"][1]["value"] is None
    assert content["machine"]["cores"] >= 1 and content["versions"]["python"]
    assert max(book["seconds"] for book in content["notebooks"]) <= content["seconds"]


def test_verdicts_are_joined(finished):
    content, folder = finished
    good, reason = content["notebooks"][2], content["reasons"][0]
    assert good["verdict"] == content["verdict"] == "not trustworthy" and content["notebooks"][0]["verdict"] is None
    assert reason == {"name": "clock", "level": "not trustworthy", "text": "183 ms > 1 ms", "cure": "Give <offset_s>."}
    for page in ("index.html", "03_good.html"):
        text = (folder / page).read_text(encoding="utf-8")
        start, place = text.index("<main"), text.index("183 ms &gt; 1 ms")
        assert place - start < 3000 and "Give <offset_s>" not in text


def test_figures_are_files(finished):
    content, folder = finished
    figure, line = content["figures"]
    assert line["file"] == "figures/calibration_line.svg"
    assert b'<svg style="max-width: 100%' in (folder / line["file"]).read_bytes()
    assert figure["file"] == "figures/calibration_residuals.png" and figure["caption"] == "Small everywhere."
    assert (folder / figure["file"]).read_bytes().startswith(b"\x89PNG")


def test_pages_need_no_network_and_show_equations(finished):
    _, folder = finished
    for file in folder.glob("*.html"):
        text = file.read_text(encoding="utf-8")
        assert not re.search(r'(src|href)="(https?:)?//', text), file
        assert "$$" not in text
    good = (folder / "03_good.html").read_text(encoding="utf-8")
    assert good.count("<svg ") == 2 and good.count("data:image/svg+xml") == 1 and "arg\\,min" in good
    assert "Small everywhere." in good and "Plotly.newPlot" in good
    assert "plotly-view" in good and (folder / "plotly.min.js").is_file()
    assert "Interactive: open the notebook" in good
    assert not re.search(r'alt=""|<img(?![^>]*alt=)', good) and 'alt="A line."' in good
    assert f' id="{finished[0]["metrics"][0]["cell"]}"' in good


def test_index_shows_paper_and_run_and_escapes_text(finished):
    text = (finished[1] / "index.html").read_text(encoding="utf-8")
    assert 'data-of="Paper">2 px</td>' in text and 'data-of="This run">4.5 px</td>' in text
    assert "of &lt;b&gt;75&lt;/b&gt; frames" in text and "It &lt;works&gt;" in text
    assert "00_error: error in cell 3: ZeroDivisionError" in text
    assert "figures/calibration_residuals.png" in text


def test_every_link_leads_somewhere(finished):
    _, folder = finished
    for file in folder.glob("*.html"):
        for link in re.findall(r'(?:href|src)="([^"#:]+)"', file.read_text(encoding="utf-8")):
            assert (folder / link).is_file(), (file.name, link)


def test_everything_is_in_one_zip(finished):
    content, folder = finished
    with zipfile.ZipFile(folder / content["download"]) as archive:
        names = {name.partition("/")[2] for name in archive.namelist()}
    assert names >= {"index.html", "metrics.json", "03_good.html", "03_good.ipynb", "figures/calibration_residuals.png"}
    assert not any(name.endswith(".zip") for name in names)


def test_a_site_is_a_copy_that_needs_no_server_of_ours(finished, tmp_path, monkeypatch, capsys):
    folder = finished[1]
    assert main_site([str(folder), "--out", str(tmp_path / "site")]) == 0
    assert (tmp_path / "site" / ".nojekyll").exists()
    assert (tmp_path / "site" / "index.html").read_text() == (folder / "index.html").read_text()
    assert main_site([str(folder), "--out", str(tmp_path / "site")]) == 2, "nothing is overwritten"
    assert "site: it exists already, or the folder for it does not; name another with --out" in capsys.readouterr().err
    monkeypatch.setattr(command.shutil, "copytree", lambda *_: (_ for _ in ()).throw(OSError("the disk is full")))
    assert main_site([str(folder), "--out", str(tmp_path / "half")]) == 2 and [p.name for p in tmp_path.iterdir()] == ["site"]
    monkeypatch.setattr(command.paths, "RUNS", tmp_path / "none")
    assert main_site(["--out", str(tmp_path / "other")]) == 2 and not (tmp_path / "other").exists()
    assert "`python3 -m lib run` makes one" in capsys.readouterr().err


def test_a_kernel_takes_no_ports_which_another_one_could_take(tmp_path, write_notebook, monkeypatch):
    """Where the system has sockets that are files, in a folder whose path leaves room for their names."""
    ask = "from ipykernel.connect import get_connection_info\nprint(get_connection_info(unpack=True)['transport'])"
    book, output = write_notebook(tmp_path, "01_ask", ask), tmp_path / "executed.ipynb"

    def transport():
        assert execute(book, output, {}) is None
        return nbformat.read(output, as_version=4).cells[-1].outputs[0].text.strip()

    assert transport() == ("ipc" if os.name == "posix" else "tcp")
    long = tmp_path / ("long" * 30)
    long.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    assert transport() == "tcp" and not list(long.iterdir())


@pytest.fixture
def without_kernels(books, monkeypatch):
    """Notebooks that end as soon as they begin: what is tested is the command around them."""
    monkeypatch.setattr(command.execution, "choose_notebooks", lambda names=(), folder=None: choose_notebooks(names, books))
    monkeypatch.setattr(command, "execute", lambda book, output, values, **options: shutil.copy(book, output) and None)
    numbers = (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM))
    before = {number: signal.signal(number, signal.SIG_DFL) for number in numbers}  # nohup's child inherits "ignore"
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def state_of(runs: Path) -> dict:
    (folder,) = runs.iterdir()
    assert {file.name for file in folder.iterdir()} >= {"metrics.json", "index.html"} and not (folder / ".room").exists()
    return json.loads((folder / "metrics.json").read_text(encoding="utf-8"))


def test_exit_codes(without_kernels, tmp_path, monkeypatch, capsys):
    assert main(["03", "--runs", str(tmp_path / "good")]) == 0
    monkeypatch.setattr(command, "execute", lambda *_, **__: Failure("error", 3, "ZeroDivisionError: division by zero"))
    assert main(["00", "--runs", str(tmp_path / "bad")]) == 1
    assert "FAILED 00_error: error in cell 3: ZeroDivisionError: division by zero" in capsys.readouterr().err
    for words, text in [(["03", "-p", "sede", "1"], "unknown parameter: sede"), (["07"], "unknown notebook: 07"),
                        (["03", "-p", "profile", "paper"], "give it as --profile"),
                        (["03", "--runs", __file__], "test_run.py")]:  # fmt: skip
        assert main(["--runs", str(tmp_path / "none"), *words]) == 2
        said = capsys.readouterr().err
        assert text in said and said.count("\n") == 1
    with pytest.raises(SystemExit):
        main(["--cell-timeout", "nan"])
    assert "nan is not a number of seconds above 0" in capsys.readouterr().err


def test_a_missing_recording_is_named_before_anything_runs(write_notebook, tmp_path):
    books, runs = tmp_path / "books", tmp_path / "runs"
    books.mkdir()
    write_notebook(books, "03_mine", parameters='recording: str = ""  # folder')
    with pytest.raises(FileNotFoundError, match=r"parameter recording: .*books has no recording\.toml"):
        run(pairs=[("recording", str(books))], runs=runs, notebooks=books)
    assert not runs.exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129), ("SIGINT", 130)])
def test_a_signal_leaves_the_state_stopped(without_kernels, tmp_path, monkeypatch, name, code):
    def killed(*_, **__):
        time.sleep(0.1)  # so that the main thread waits: it sees a signal just before that only when the wait is over
        os.kill(os.getpid(), getattr(signal, name))
        time.sleep(0.5)  # a kernel takes a moment to end

    monkeypatch.setattr(command, "execute", killed)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job inherits "ignore"
    try:
        assert main(["03", "--runs", str(tmp_path)]) == code
    finally:
        signal.signal(signal.SIGINT, before)
    content = state_of(tmp_path)
    assert content["state"] == "stopped" and content["notebooks"][0]["state"] == "pending"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
def test_a_run_under_nohup_outlives_its_terminal(without_kernels, tmp_path):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert main(["03", "--runs", str(tmp_path)]) == 0
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN and signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL


def test_no_room_for_the_zip_leaves_a_complete_run_without_it(without_kernels, tmp_path, monkeypatch):
    def half(base, *_):
        Path(f"{base}.zip").write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(command.shutil, "make_archive", half)
    assert main(["03", "--runs", str(tmp_path)]) == 0
    assert state_of(tmp_path)["download"] is None  # and the run's folder is all there is


def test_the_notebooks_of_a_run_share_a_folder_that_goes_with_it(without_kernels, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    named, execute = [], command.execute

    def looked(*arguments, **options):
        named.append(Path(os.environ[paths.SHARED_VARIABLE]))
        assert list(named[-1].iterdir()) == [named[0] / "kept"] * (len(named) > 1)
        (named[-1] / "kept").touch()
        return execute(*arguments, **options)

    monkeypatch.setattr(command, "execute", looked)
    run(["03", "04"], runs=tmp_path / "runs", jobs=1)
    assert len(named) == 2 and named[0] == named[1] and named[0].parent == tmp_path / "cache"
    assert not named[0].exists() and paths.SHARED_VARIABLE not in os.environ


def test_a_full_disk_is_told_and_leaves_the_state_failed(without_kernels, tmp_path, monkeypatch, capsys):
    """The executed notebook is cut off; then nothing can be written until room is made."""
    write_bytes = command.files.write_bytes

    def full(path, data):
        if full.now and (path.parent / ".room").exists():
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write_bytes(path, data)

    def cut_off(book, output, values, **options):
        output.write_text('{"cells": [', encoding="utf-8")
        full.now = True
        return Failure("error", 1, "OSError: No space left on device")

    full.now = False
    monkeypatch.setattr(command.files, "write_bytes", full)
    monkeypatch.setattr(command, "execute", cut_off)
    assert main(["03", "--runs", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "No space left on device" in said and f"The run in {tmp_path}" in said and said.count("\n") == 1
    content = state_of(tmp_path)
    assert content["state"] == "failed" and "No space left" in content["notebooks"][0]["failure"]["message"]


def test_a_killed_run_leaves_a_report_and_the_next_its_own(books, without_kernels, tmp_path, monkeypatch):
    """kill -9 while the second of two notebooks runs, as soon as metrics.json says so: the page says it too."""
    code = """
import shutil, sys, time
from pathlib import Path
from lib import paths
from lib.workbench import command

def execute(book, output, values, **options):
    time.sleep(60 if book.stem == "02_dead" else 0)
    shutil.copy(book, output)

def slow_page(content, page=command.pages.index_html):
    time.sleep(0.3)
    return page(content)

command.execute, command.pages.index_html, paths.CACHE = execute, slow_page, Path(sys.argv[3])
command.run(["00", "02"], runs=Path(sys.argv[1]), notebooks=Path(sys.argv[2]))
"""
    runs, cache = tmp_path / "runs", tmp_path / "cache"
    words = [sys.executable, "-c", code, str(runs), str(books), str(cache)]
    process = subprocess.Popen(words, cwd=paths.ROOT, stdout=subprocess.DEVNULL)
    states: list[str] = []
    while states != ["complete", "running"]:
        assert process.poll() is None
        time.sleep(0.05)
        for file in runs.glob("*/metrics.json"):
            states = [book["state"] for book in json.loads(file.read_text(encoding="utf-8"))["notebooks"]]
    process.kill()
    process.wait()
    (cache / f"run-{os.getpid()}-other").mkdir()
    assert len(list(cache.iterdir())) == 2
    monkeypatch.setattr(paths, "CACHE", cache)
    assert run(["00"], runs=runs, notebooks=books)["state"] == "complete"
    assert [folder.name for folder in cache.iterdir()] == [f"run-{os.getpid()}-other"], "that of a run that goes on"
    first, second = sorted(runs.iterdir(), key=lambda folder: len(folder.name))
    assert second.name == f"{first.name}-2"
    assert json.loads((first / "metrics.json").read_text(encoding="utf-8"))["state"] == "running"
    assert "00_error.html" in (first / "index.html").read_text(encoding="utf-8")


# --- several notebooks at once

CLOCKED = "start = time.time(); time.sleep(0.2); print('ran', start, time.time())"


def test_notebooks_run_at_once_but_for_cells_that_must_run_alone(write_notebook, tmp_path):
    for own, other in (("00_first", "01_second"), ("01_second", "00_first")):
        meet = (
            f"import pathlib, time; pathlib.Path({str(tmp_path / own)!r}).touch()\n"
            f"while not pathlib.Path({str(tmp_path / other)!r}).exists(): time.sleep(0.01)"
        )
        write_notebook(tmp_path, own, meet, *[CLOCKED] * 3)
    content = nbformat.read(tmp_path / "01_second.ipynb", as_version=4)
    for cell in content.cells[-2:]:
        cell.metadata.tags = [ALONE]
    nbformat.write(content, tmp_path / "01_second.ipynb")
    assert run(cell_timeout_s=60, runs=tmp_path / "runs", notebooks=tmp_path, jobs=2)["state"] == "complete"
    texts = [file.read_text(encoding="utf-8") for file in sorted(tmp_path.glob("runs/*/*.ipynb"))]
    first, second = (np.array(re.findall(r"ran (\d+\.\d+) (\d+\.\d+)", text), dtype=float) for text in texts)
    overlap_s = np.minimum(first[:, None, 1], second[:, 1]) - np.maximum(first[:, None, 0], second[:, 0])
    assert overlap_s.shape == (3, 3) and (overlap_s[:, -2:] < 0).all()


def test_who_waits_to_run_alone_is_not_overtaken():
    """Two threads change places all the time; the third gets all places nevertheless, and gives them back."""
    alone, usual = (nbformat.v4.new_code_cell("", metadata={"tags": tags}) for tags in ([ALONE], []))
    places, running, seen, over = Places(3), set(), [], threading.Event()

    def often():
        with places.taken() as begin:
            while not over.is_set():
                begin(usual)
                running.add(threading.get_ident())
                time.sleep(0.001)
                running.discard(threading.get_ident())

    with ThreadPoolExecutor(2) as pool:
        others = [pool.submit(often) for _ in range(2)]
        with places.taken() as begin:
            for _ in range(20):
                begin(alone)
                seen.append(len(running))
                begin(usual)
        over.set()
        assert [other.result(10) for other in others] == [None, None] and seen == [0] * 20
    places.closed = True
    with places.taken() as begin, pytest.raises(RuntimeError, match="stopped"):
        begin(usual)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
def test_a_stopped_run_ends_its_kernels(write_notebook, tmp_path):
    for name in ("00_first", "01_second"):
        write_notebook(tmp_path, name, "import os, pathlib, time; pathlib.Path(f'{os.getpid()}.pid').touch(); time.sleep(99)")
    code = """
import os, sys
from pathlib import Path
from lib.workbench import command, execution
os.chdir(sys.argv[1])
choose = execution.choose_notebooks
execution.choose_notebooks = lambda names, folder: choose(names, Path.cwd())
sys.exit(command.main(["--runs", "runs", "--jobs", "2"]))
"""
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=paths.ROOT, stdout=subprocess.DEVNULL)
    while len(kernels := [int(file.stem) for file in tmp_path.glob("*.pid")]) < 2:
        assert process.poll() is None
        time.sleep(0.05)
    process.terminate()
    assert process.wait(20) == 128 + signal.SIGTERM and not any(map(psutil.pid_exists, kernels))
    content = state_of(tmp_path / "runs")
    assert content["state"] == "stopped" and [book["state"] for book in content["notebooks"]] == ["pending"] * 2


def test_less_than_one_notebook_at_once_is_refused(books, tmp_path):
    with pytest.raises(ValueError, match="jobs: 0 notebooks at once; give at least 1"):
        run(["03"], jobs=0, runs=tmp_path / "runs", notebooks=books)
    assert not (tmp_path / "runs").exists()
