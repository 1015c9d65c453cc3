"""What holds for every notebook that ships: `python3 -m lib run` executes the walk, `sweep` the studies."""

from __future__ import annotations

import ast
import dataclasses
import re
import shutil
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest

from lib import paths, trust
from lib.landmarks import Detector, Landmarks
from lib.recordings import Annotator, Recording, RecordingWriter
from lib.trust import check
from lib.workbench import pages, report, results
from lib.workbench.execution import ALONE, declared_grid, declared_parameters, parse_parameters
from notebooks.figures import verdicts
from notebooks.figures.course import in_range
from tests.remembering import remembering_recordings

WALK = sorted(paths.NOTEBOOKS.glob("*.ipynb"))
STUDIES = sorted(paths.NOTEBOOKS.glob("studies/*.ipynb"))
ORDER = ["00_overview", "01_data", "02_landmark_detection", "03_affine_calibration", "04_stereo_reconstruction",
         "05_registration", "06_online_pipeline", "07_your_own_recording",
         "08_the_robot_labels"]  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def looked_at_once():
    """Notebooks open the same two recordings."""
    with remembering_recordings():
        yield


def each(notebooks):
    return pytest.mark.parametrize("path", notebooks, ids=[path.stem for path in notebooks])


@cache
def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(path):
    return [cell for cell in read(path).cells if cell.cell_type == "code"]


def test_they_are_all_there():
    assert [path.stem for path in WALK] == ORDER and len(STUDIES) >= 20


@each(WALK + STUDIES)
def test_valid_and_without_outputs(path):
    notebook = read(path)
    nbformat.validate(notebook)
    assert "widgets" not in notebook.metadata and "papermill" not in notebook.metadata
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in code_cells(path):
        assert cell.outputs == [] and cell.execution_count is None, "clear all outputs before committing"


@each(WALK + STUDIES)
def test_cell_ids_are_stable_and_unique(path):
    start = path.stem.replace("_", "-") if path in STUDIES else path.stem[:2]
    ids = [cell.id for cell in read(path).cells]
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch(rf"{start}-[a-z0-9-]+", name) for name in ids), ids


@each(WALK + STUDIES)
def test_parameters_are_typed_and_commented(path):
    first = code_cells(path)[0]
    assert first.metadata.get("tags") == ["parameters"]
    names = []
    for statement in ast.parse(first.source).body:
        assert isinstance(statement, ast.AnnAssign) and statement.value is not None, ast.unparse(statement)
        line = first.source.splitlines()[statement.lineno - 1]
        assert statement.lineno == statement.end_lineno, "papermill reads one line a parameter"
        assert re.search(r"#\s+\S+", line), f"what is it? {line}"
        names.append(statement.target.id)
    assert path in STUDIES or names[:2] == ["profile", "seed"]


@each(WALK + STUDIES)
def test_a_parameter_keeps_its_value_after_the_first_cells(path):
    parameters, *others = code_cells(path)
    names = {statement.target.id for statement in ast.parse(parameters.source).body}
    for cell in others[3:]:
        tree = ast.parse("\n".join(line for line in cell.source.splitlines() if not line.startswith("%")))
        inner = (ast.FunctionDef, ast.Lambda, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
        own = {node for part in ast.walk(tree) if isinstance(part, inner) for node in ast.walk(part)}
        stored = {n for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)} - own
        assert not names & {node.id for node in stored}, cell.id


@each(WALK)
def test_what_takes_the_time_of_a_cell_runs_alone(path):
    """Else the time would depend on what the other notebooks of the run compute at that moment."""
    timed = re.compile(r"report\.timed\(|perf_counter\(|timeit\.|max_seconds=|minutes=|SharedDetector\(\)|\.step\(")
    for cell in code_cells(path)[1:]:
        if timed.search(cell.source) and "basis" not in cell.metadata.get("tags", []):
            assert ALONE in cell.metadata.get("tags", []), cell.id


@each(WALK)
def test_opens_with_a_title_and_closes_with_lessons_and_exercises(path):
    cells = read(path).cells
    assert re.match(r"# \d\. \S", cells[0].source)
    prose = "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
    assert "What we learnt" in prose and "Exercises" in prose


@each(STUDIES)
def test_a_study_asks_measures_and_says_how_to_read_its_table(path):
    cells = read(path).cells
    assert re.match(r"# Study: .*\?", cells[0].source) and cells[1].metadata.get("tags") == ["parameters"]
    assert any("report.record(" in cell.source for cell in code_cells(path))
    assert cells[-1].source.startswith("## Reading the table")


@each(STUDIES)
def test_the_grid_fits_the_parameters(path):
    for name, values in declared_grid(path).items():
        assert values, name
        for value in values:
            assert value[0] not in "\"'", f"{name}: a text in a grid stands without quotes: {value}"
            parse_parameters([(name, value)], [path])
    table = results.read(path.stem)
    if table is not None:
        varied = {name for name, values in declared_grid(path).items() if len(values) > 1}
        assert varied <= set(table.columns), "the recorded table lacks a parameter of the grid"
        assert {"command", "commit", "machine", "date"} <= set(table.provenance)


def test_every_recorded_table_has_its_study():
    assert {path.stem for path in paths.RESULTS.glob("*.csv")} <= {path.stem for path in STUDIES}


@each(WALK + STUDIES)
def test_names_no_folder_of_one_machine(path):
    text = path.read_text(encoding="utf-8")
    assert not re.search(r'["\'\s](/home/|/Users/|/root/|/tmp/|[A-Z]:\\\\)', text)


@each(WALK + STUDIES)
def test_equations_can_be_drawn(path):
    for cell in read(path).cells:
        if cell.cell_type == "markdown":
            html = pages.markdown_html(cell.source, folder=path.parent)
            left_as_tex = re.findall(r'<code class="tex">(.*?)</code>', html)
            assert not left_as_tex, f"{cell.id}: {left_as_tex}"


@each(WALK + STUDIES)
def test_parameters_can_be_read_by_papermill(path):
    assert all(declared_parameters(path).values())


# --- a recording that is not ours: six small frames, no truth, no labels, no position of the robot at one frame

#: Cells that do not look at the recording, or look at the real detector's inside: left out here, `lib run` executes them.
ELSEWHERE = {
    "00": "",
    "01": "01-(rig|effects|slider|pair|check|motion|format|scenes|training|realism|dataset).*",
    "02": "02-(04|06|08|10|12|13|37|hourglass|half-pixel|loss|eq1|disc|decoding|(03|heat|eq1|11)-record).*",
    "03": "03-(data|dlt|resec|elim|pers|claim|ener|weig|fit|lad|dist|uncert|elli|advice|clock|record|reso|boar|fac|robot).*",
    "04": "04-(desc|pyr|top|two|epi|match|fields|l1|spli|eq6|smoo|cvxpy|surface-r|exp|err|gal|recor|sca|real|distance-sc).*",
    "05": "05-(one|eq7|ellipses|experiment|robust|icp|alone|drift).*",
    "06": "06-slider",
    "07": "",
}
#: Numbers that only a calibration that is believed may give.
FOLLOWS = re.compile(
    "overview_(height|triang|surf|regis)|surface_|tool_|reconstruction_(sigma|depth)|registration_error|pipeline_|"
    "own_(reprojection|held_out|surface|motion)"
)
N_FRAMES, SHRINK, BLANK_FRAME = 6, 4, 2


class Seer:
    """Finds the landmarks where they are in the frame whose number stands in the image's corner, mirrored or shifted too."""

    metadata, networks = {}, {}

    def __init__(self, sighted: bool):
        truth, rng = Recording.open(paths.SHIPPED_RECORDING).truth, np.random.default_rng(0)
        exact = np.stack([truth.u_left, truth.u_right], axis=1)[:N_FRAMES]
        self.u = (exact + 0.5) / SHRINK - 0.5 + rng.normal(0, 0.1, exact.shape)
        self.sighted = sighted

    def __call__(self, images: np.ndarray) -> Landmarks:
        if not self.sighted:
            return Landmarks.none(len(images))
        mirrored = images[0, :8, :8].std() > 0
        image = images[0, :, ::-1] if mirrored else images[0]
        y, x = (np.flatnonzero(image.any(axis=axes))[0] for axes in ((1, 2), (0, 2)))
        number = round(image[y : y + 8, x : x + 8].mean() / 20) - 1  # images that a notebook makes have none
        u = self.u[number % N_FRAMES] + (x, y)
        if mirrored:
            u = np.stack([images.shape[2] - 1 - u[..., 0], u[..., 1]], axis=-1)[:, [0, 2, 1]]
        return Landmarks(u, np.tile(0.01 * np.eye(2), (2, 3, 1, 1)), np.full((2, 3), 0.9))

    def track(self, images: np.ndarray, previous: Landmarks) -> Landmarks:
        return self(images)


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    """The recording, from a sixteenth of the pixels of the one that ships."""
    source = Recording.open(paths.SHIPPED_RECORDING)
    size = tuple(side // SHRINK for side in source.image_size_px)
    folder = tmp_path_factory.mktemp("recording") / "mine"
    x, time_s = source.kinematics.x_mm.copy(), source.kinematics.time_s
    x[np.abs(time_s - source.frames.time_s[BLANK_FRAME] - source.offset_s) < 0.05] = np.nan
    header = {"name": "mine", "fps": source.fps, "image_size_px": size, "readout_s": source.readout_s}
    with RecordingWriter(folder, **header, suffix=".png") as writer:
        for number in range(N_FRAMES):
            frame = source.frames[number]
            pair = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (frame.left, frame.right)]
            for image in pair:
                image[:8, :8] = 20 * (number + 1)
            writer.add(*pair, time_s=frame.time_s)
        writer.kinematics(time_s, x)
    return folder


class Stopped(Exception):
    """In place of the end that `report.stop` makes."""


class Run:
    """A notebook's code run in this process: what it records and shows, and why it stopped."""

    def __init__(self, number: str, recording: Path, monkeypatch, *, sighted: bool = True, **parameters):
        self.metrics, self.captions, self.verdicts, self.left_out = {}, [], [], None
        monkeypatch.setattr(Detector, "load", lambda *_, **__: Seer(sighted))
        monkeypatch.setattr(report, "record", lambda name, value, unit, **_: self.metrics.update({name: value}))
        for name, replacement in {"show": self.show, "verdict": self.verdicts.append, "stop": self.stop}.items():
            monkeypatch.setattr(report, name, replacement)
        names: dict = {"__name__": "notebook"}
        (path,) = (path for path in WALK if path.stem.startswith(number))
        for cell in code_cells(path):
            if re.fullmatch(ELSEWHERE[number], cell.id):
                continue
            code = "\n".join(line for line in cell.source.splitlines() if not line.startswith("%"))
            try:
                exec(compile(code, cell.id, "exec"), names)
            except Stopped as reason:
                self.left_out = str(reason)
                return
            if cell.metadata.get("tags") == ["parameters"]:
                names |= {"recording": str(recording)} | parameters

    def show(self, page, name, caption):
        page.set_dpi(30)  # pixels take time, and nobody looks at them
        page.canvas.draw()
        plt.close(page)
        self.captions.append(caption)

    def stop(self, reason):
        raise Stopped(reason)


@pytest.mark.parametrize("number", ["00", "01", "03", "05", "06", "07", pytest.param("04", marks=pytest.mark.slow)])
def test_a_short_recording_without_truth_runs_and_no_caption_speaks_of_a_truth(number, small, monkeypatch):
    run = Run(number, small, monkeypatch)
    assert run.left_out is None and (run.captions or number == "05")
    assert not [caption for caption in run.captions if re.search(r"\btru(e|th)\b", caption)]
    assert len(run.verdicts) == (number != "01")
    if number == "00":
        assert np.isfinite(run.metrics["overview_height_um"]) and "overview_triangulation_um" not in run.metrics
    if number == "01":
        assert run.metrics["data_frames_without_kinematics"] == 1
    if number == "06":
        assert run.metrics["pipeline_frames_to_calibration"] <= N_FRAMES and "pipeline_push_error_um" not in run.metrics
    if number == "07":
        assert run.metrics["own_surface_points"] > 100 and "own_clock_offset_ms" not in run.metrics


@pytest.mark.parametrize("number", ["00", "02", "03", "04", "05", "06", "07"])
def test_where_nothing_is_detected_a_notebook_says_so_and_states_no_number(number, small, monkeypatch):
    run = Run(number, small, monkeypatch, sighted=False, force=True)
    assert "left out" in run.left_out and run.verdicts[-1].is_red
    assert not [name for name in run.metrics if FOLLOWS.match(name)]
    assert number in ("03", "05", "06") or run.captions, "the frames are shown"


@pytest.mark.parametrize("number", ["00", "05"])
def test_a_red_calibration_gives_no_number_unless_forced(number, small, monkeypatch):
    red = trust.Verdict((trust.Reason("residuals", trust.LEVELS[-1], "They are large.", "Look."),))
    assess = trust.assess
    monkeypatch.setattr(trust, "assess", lambda *a, **k: dataclasses.replace(assess(*a, **k), verdict=red))
    run = Run(number, small, monkeypatch)
    assert "not trustworthy" in run.left_out and not [name for name in run.metrics if FOLLOWS.match(name)]
    assert Run(number, small, monkeypatch, force=True).left_out is None


def test_notebook_7_says_what_to_do_on_a_red_verdict(small, monkeypatch, capsys):
    red = trust.Verdict((trust.Reason("residuals", trust.LEVELS[-1], "They are large.", "Look."),))
    assess = check.assess
    monkeypatch.setattr(check, "assess", lambda *a, **k: dataclasses.replace(assess(*a, **k), verdict=red))
    assert "not trustworthy" in Run("07", small, monkeypatch).left_out
    assert re.search(r"^Then what\? +Look\.$", capsys.readouterr().out, re.MULTILINE)


def answers_of_notebook_7(small, monkeypatch, capsys, *reasons, cause=None, **parameters):
    """What notebook 7 answers in words where the verdict has these reasons: (name, level, text, cure)."""
    told = trust.Verdict(tuple(trust.Reason(*reason) for reason in reasons))
    found = None if cause is None else SimpleNamespace(name=cause, images=(0, 1), text="The cause.", cure="Mend the cause.")
    assess, diagnosis = check.assess, SimpleNamespace(best=found, hypotheses=())
    monkeypatch.setattr(
        check, "assess", lambda *a, **k: dataclasses.replace(assess(*a, **k), verdict=told, diagnosis=diagnosis)
    )
    Run("07", small, monkeypatch, **parameters)
    return re.sub(r"\s+", " ", capsys.readouterr().out)


def test_notebook_7_puts_a_named_cause_before_the_detector(small, monkeypatch, capsys):
    red = trust.LEVELS[-1]
    reasons = [(name, red, f"Text of {name}.", f"Cure of {name}.") for name in ("clock", "no_consensus", "coverage")]
    said = answers_of_notebook_7(small, monkeypatch, capsys, *reasons, cause="clock")
    assert "Enough motion? Not known" in said and "Is the detector usable? Yes." in said
    assert "Do the clocks agree? No. Text of clock. Cure of clock. Is" in said
    assert "Then what? Cure of clock." in said
    monkeypatch.undo()
    moved = ("camera_moved", red, "Text of camera_moved.", "Cure of camera_moved.")
    said = answers_of_notebook_7(small, monkeypatch, capsys, moved, *reasons[1:], cause="camera_moved")
    assert "Then what? Text of camera_moved. Cure of camera_moved." in said


def test_notebook_7_without_a_cause_asks_for_the_detector_and_for_motion(small, monkeypatch, capsys):
    levels = {"no_consensus": trust.LEVELS[-1], "one_plane": trust.LEVELS[1], "thin": trust.LEVELS[1]}
    reasons = [(name, level, f"Text of {name}.", f"Cure of {name}.") for name, level in levels.items()]
    said = answers_of_notebook_7(small, monkeypatch, capsys, *reasons)
    assert "Enough motion? In doubt. Text of one_plane. Cure of one_plane. Text of thin. Cure of thin. Do" in said
    then = r"Then what\? Adapt; then label 10 stereo frames\."
    assert re.search(rf"usable\? No\. Text of no_consensus\. \d of 6 frames are bad\. {then}", said)
    part = answers_of_notebook_7(small, monkeypatch, capsys, *reasons, frames="1:5")
    assert re.search(r"usable\? No\. Text of no_consensus\. \d of 4 frames are bad\.", part)


@pytest.mark.parametrize("labelled", [0, 1, 4])
def test_notebook_7_asks_for_more_labels_where_few_frames_have_some(labelled, small, tmp_path, monkeypatch, capsys):
    mine = Path(shutil.copytree(small, tmp_path / "my labels"))
    annotator = Annotator(Recording.open(mine))
    for number in range(labelled):
        for side, u in zip(("left", "right"), Seer(True).u[number], strict=True):
            for name, point in zip(annotator.recording.skeleton, u, strict=True):
                annotator.mark(side, number, name, tuple(point))
    run = Run("07", mine, monkeypatch, landmarks="annotations", force=True)
    if labelled < 2:
        assert f"labels in {labelled} stereo frames" in run.left_out and not run.verdicts
        return
    cures = [reason.cure for reason in run.verdicts[0].reasons if reason.name == "few_frames"]
    assert len(cures) == 1 and "annotate" in cures[0] and "Record more" not in capsys.readouterr().out
    assert run.captions[0] == "Your labels in frame 0." and run.left_out is None
    part = Run("07", mine, monkeypatch, landmarks="annotations", frames="3:6")
    assert "labels in 1 stereo frames" in part.left_out  # those of frames 0 to 2 do not count


def test_wrong_labels_come_before_the_noise_that_they_make(small):
    parts = {"epipolar": np.full((6, 3), 0.5), "robot": np.full((6, 3), 2.0)}
    red, health = trust.LEVELS[-1], trust.Health(np.arange(6), parts, np.ones((6, 3), dtype=bool))
    reasons = (trust.Reason("robot_noise", red, "Noise.", "Check."), trust.Reason("minority", red, "Few.", "Look again."))
    found = SimpleNamespace(
        verdict=trust.Verdict(reasons), diagnosis=SimpleNamespace(best=SimpleNamespace(name="robot_noise", images=(0, 1))),
        health=health, calibration=None,
    )  # fmt: skip
    answers, bad, _ = verdicts.in_words(Recording.open(small), found, None)
    assert answers["Then what?"] == "Look again." and bad == 6
    answers, bad, note = verdicts.in_words(Recording.open(small), found, "Check.")
    assert answers["Then what?"] == "Noise. Check." and bad == 0 and "another cause" in note
    parts["epipolar"][:] = 2.0
    for found.diagnosis.best.images, n_bad in (((0, 1), 6), ((1,), 0)):  # where one image errs, the pair disagrees anyway
        assert verdicts.in_words(Recording.open(small), found, "Check.")[1] == n_bad
    parts["epipolar"][:] = 0.5
    amber = trust.Reason("base", trust.LEVELS[1], "The base is off.", "Look.")
    found = SimpleNamespace(verdict=trust.Verdict((amber,)), diagnosis=trust.Diagnosis(), health=health, calibration=None)
    answers, _, _ = verdicts.in_words(Recording.open(small), found, "Check.")
    assert answers["Is the detector usable?"] == "In doubt. The base is off. 6 of 6 frames are bad."
    assert answers["Then what?"].startswith("Adapt")


def test_notebook_7_says_what_it_needs_of_landmarks_and_weights(small, tmp_path, monkeypatch):
    other = Path(shutil.copytree(small, tmp_path / "other"))
    for file in ("recording.toml", "kinematics.csv"):
        (other / file).write_text((other / file).read_text(encoding="utf-8").replace("tip_2", "end"), encoding="utf-8")
    assert "-p landmarks annotations" in Run("07", other, monkeypatch).left_out
    with pytest.raises(ValueError, match="place of a detector"):
        Run("07", small, monkeypatch, weights="mine.safetensors", landmarks="annotations")


def test_what_judges_a_recording_is_said(small, tmp_path):
    ours, foreign = Recording.open(paths.SHIPPED_RECORDING), Recording.open(small)
    bare = SimpleNamespace(truth=SimpleNamespace(folder=tmp_path), annotations=None)
    assert verdicts.true_surface(ours) is not None
    assert verdicts.true_surface(foreign) is verdicts.true_surface(bare) is None
    assert "no truth" in verdicts.whether_true(foreign) and "surface" not in verdicts.whether_true(ours)
    assert "holds no surface" in verdicts.whether_true(bare)


OUT_OF_RANGE = [
    ("01", "real_frames", 0), ("02", "n_train", 8), ("02", "textures", 0), ("02", "every", 0), ("03", "n_rows", 6),
    ("03", "sigma_u_px", 0.0), ("03", "sigma_x_mm", 0.0), ("04", "frame", -1), ("04", "frame", 34),
    ("05", "outliers", 1.5), ("05", "sigma_u_px", -1.0), ("05", "sigma_x_mm", float("nan")), ("06", "bump_after", 0.0),
    ("06", "bump_after", 1.0), ("08", "wrong", 1.5), ("08", "sigma_px", 0.0), ("08", "minutes", 0.0),
]  # fmt: skip


@pytest.mark.parametrize(("number", "name", "value"), OUT_OF_RANGE)
def test_a_parameter_out_of_range_is_refused_in_one_line_that_names_it(number, name, value):
    (path,) = (path for path in WALK if path.stem.startswith(number))
    names = {"in_range": in_range, "source": range(34), "TEXTURE_SEEDS": range(96)}
    exec(code_cells(path)[0].source, names)
    for call in in_range_calls(path):
        eval(call, names)  # the defaults are in range
    names[name] = value
    with pytest.raises(ValueError, match=rf"^{name} = {value:g}: give a value from \S+ to \S+\.$"):
        [eval(call, names) for call in in_range_calls(path)]


def in_range_calls(path):
    """The calls of `in_range` in a notebook's first cells, compiled."""
    for cell in code_cells(path)[:4]:
        tree = ast.parse("\n".join(line for line in cell.source.splitlines() if not line.startswith("%")))
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "in_range":
                yield compile(ast.Expression(node), path.stem, "eval")
