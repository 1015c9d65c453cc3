"""The data set's command: progress, parallel work, resuming after a kill, the same files for the same seed."""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from lib import paths
from lib.recordings import Recording
from lib.simulator.dataset import main, make_dataset, sequence_design, sequence_name
from notebooks.figures.data import landmark_counts, volume_page

OPTIONS = {"n_pairs": 2, "duration_s": 1.0, "shrink": 16}  # 120 x 67 px
WORDS = ["--pairs", "2", "--duration", "1", "--shrink", "16"]
NAMES = {sequence_name(k) for k in range(10)}


def one_by_one(function, jobs, **options):
    for path, arguments in jobs.items():
        function(path, *arguments)
        yield path, None


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two pairs of each sequence, made in this process; treated as read-only."""
    folder = tmp_path_factory.mktemp("dataset") / "made"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lib.simulator.dataset.run_jobs", one_by_one)
        assert make_dataset(folder, **OPTIONS) == [folder / sequence_name(k) for k in range(10)]
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of the sequences by its name."""
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.glob("t*_*/**/*") if f.is_file()}


def test_splits_by_eye_and_tool(made):
    recordings = [Recording.open(made / name) for name in sorted(NAMES)]
    assert [recording.name[:5] for recording in recordings].count("train") == 7
    assert {len(recording) for recording in recordings} == {2}
    # Ten tools: no two have jaws of the same length.
    jaws = [np.linalg.norm(r.truth.landmarks_mm[0, 1:].mean(axis=0) - r.truth.landmarks_mm[0, 0]) for r in recordings]
    assert np.diff(np.sort(jaws)).min() > 1e-4
    counts = landmark_counts(recordings)
    assert {sum(counts[name][k] for k in ("visible", "hidden", "outside")) for name in counts} == {10 * 2 * 2}
    assert counts["base"]["visible"] > 20 and "in_glint" in counts["tip_1"]


def test_the_legend_of_the_labels_covers_no_point():
    page = volume_page(Recording.open(paths.SHIPPED_RECORDING))
    page.canvas.draw()
    (legend,) = page.legends
    for axes in page.axes:
        assert axes.get_legend() is None and not legend.get_window_extent().overlaps(axes.get_window_extent())
    plt.close(page)


def test_a_killed_run_resumes_to_the_same_files(made, tmp_path, capfd):
    """kill -9 in the middle, once the workers are at it; another number of workers finishes the rest."""
    folder = tmp_path / "killed"
    command = [sys.executable, "-m", "lib", "simulate", "--folder", str(folder), *WORDS]
    run = subprocess.Popen([*command, "--workers", "2"], cwd=paths.ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        wait_for(lambda: 2 <= len(finished(folder)) and any(folder.glob("*.partial")), run)
        workers = children(run.pid)
    finally:
        run.kill()  # SIGKILL: nothing can be tidied up
    run.communicate()
    wait_for(lambda: not any(alive(pid) for pid in workers), None)  # else they would write beside the next run
    kept = finished(folder)
    assert kept < NAMES
    before = {name: (folder / name).stat().st_mtime_ns for name in kept}
    main(["--folder", str(folder), "--workers", "1", *WORDS])
    assert finished(folder) == NAMES and not any(folder.glob("*.partial"))
    assert {name: (folder / name).stat().st_mtime_ns for name in kept} == before
    assert contents(folder) == contents(made)
    said = capfd.readouterr()  # progress is counted in sequences, with the remaining time
    assert f"{20 - 2 * len(kept)} of 20 stereo pairs to make" in said.out and "s a pair" in said.out
    assert re.search(r"10/10 \[\d\d:\d\d<\d\d:\d\d", said.err)


def test_sequences_depend_on_seed_and_index_alone():
    assert sequence_design(0, 8) == sequence_design(0, 8)
    assert len({repr(sequence_design(seed, index)) for seed in (0, 1) for index in range(10)}) == 20


def test_says_beforehand_how_long_and_how_large(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lib.simulator.dataset.seconds_a_pair", lambda shrink: 2.0)
    main(["--folder", str(tmp_path / "new"), "--dry-run", "--workers", "2"])
    said = capsys.readouterr().out
    assert "800 of 800 stereo pairs" in said and "13 min on 2 idle cores" in said and "0.50 GB" in said
    main(["--folder", str(tmp_path / "new"), "--dry-run", "--workers", "1"])
    assert "27 min on 1 idle core, 0.50 GB" in capsys.readouterr().out
    assert not (tmp_path / "new").exists()


def test_another_data_set_in_the_folder_is_refused(made):
    with pytest.raises(ValueError, match="another data set"):
        make_dataset(made, **(OPTIONS | {"n_pairs": 4}))
    main(["--folder", str(made), *WORDS])  # nothing left to make


def test_a_damaged_sequence_is_named_and_not_passed_over(made, tmp_path):
    folder = shutil.copytree(made, tmp_path / "damaged")
    shutil.rmtree(folder / "train_00")
    (folder / "train_03" / "left" / "000001.jpg").write_bytes(b"")
    with pytest.raises(ValueError, match=r"train_03: damaged .*000001\.jpg.* Delete the folder"):
        main(["--folder", str(folder), *WORDS])
    assert (folder / "train_03").is_dir() and not (folder / "train_00").exists()


@pytest.mark.parametrize(
    "words",
    [["--seed", "-1"], ["--duration", "nan"], ["--duration", "0"], ["--pairs", "0"], ["--folder", "{file}"],
     ["--pairs", "27"], ["--shipped"], ["--shipped", "--rung", "near"], ["--rung", "near", "--dry-run"], ["--overwrite"]],
)  # fmt: skip
def test_wrong_values_end_with_a_message(words, tmp_path, monkeypatch):
    """Of argparse, or as an error that `python3 -m lib` tells in one line."""
    monkeypatch.setattr(paths, "SHIPPED_RECORDING", tmp_path / "shipped")
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises((SystemExit, OSError)):
        main(WORDS + [word.format(file=tmp_path / "file") for word in words])


def test_two_runs_at_once_do_not_end_each_other(made, tmp_path, monkeypatch):
    """The other run has made one sequence meanwhile and is writing another; a third run was killed."""
    folder = shutil.copytree(made, tmp_path / "shared")
    shutil.rmtree(folder / "train_01")
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    own, old = (folder / f"train_01.{pid}-a1b2c3.partial" for pid in (os.getpid(), ended.pid))
    own.mkdir()
    old.mkdir()

    def late(function, jobs, **options):
        yield folder / "train_00", FileExistsError("train_00: exists already")
        yield folder / "train_01", ValueError("a fault of its own")

    monkeypatch.setattr("lib.simulator.dataset.run_jobs", late)
    with pytest.raises(ValueError, match="a fault of its own"):
        make_dataset(folder, **OPTIONS)
    assert own.exists() and not old.exists()


def test_a_recording_with_a_shift_is_replaced_on_request(tmp_path):
    words = ["--rung", "near", "--folder", str(tmp_path / "near"), *WORDS]
    main(words)
    with pytest.raises(FileExistsError, match="--overwrite"):
        main(words)
    main([*words, "--pairs", "1", "--overwrite"])
    assert len(Recording.open(tmp_path / "near")) == 1


def finished(folder: Path) -> set[str]:
    return {p.name for p in folder.glob("t*_??")}


def wait_for(true, run: subprocess.Popen | None, timeout_s: float = 300.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not true():
        assert run is None or run.poll() is None, run.communicate()[1].decode()
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


def children(pid: int) -> list[int]:
    """Processes whose parent is `pid`; empty where there is no /proc."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
