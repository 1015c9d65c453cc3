"""detect, calibrate, reconstruct and register on the command line: the files they write, and when they write none."""

import json
import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from urllib.parse import quote

import cv2
import nbformat
import numpy as np
import pytest

from lib import commands, paths
from lib.calibration import LandmarkOffsets, calibrate, with_offsets
from lib.cameras import StereoRig
from lib.correspondences import of_recording
from lib.landmarks import Detector, Landmarks
from lib.matching import RigMisfitError
from lib.recordings import Recording
from lib.simulator import Design, Eye, Microscope, simulate
from lib.surface import export
from lib.trust import check
from notebooks.studies.simulated_rows import simulate_correspondences
from tests.importing import foreign
from tests.importing.test_import import source_of, thinned
from tests.remembering import remembering_recordings

LABELS = ["--landmarks", "annotations"]


@pytest.fixture(scope="module", autouse=True)
def looked_at_once():
    """Commands open the same recordings."""
    with remembering_recordings():
        yield


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """The results of `calibrate` on the shipped recording's labels."""
    folder = tmp_path_factory.mktemp("results")
    assert commands.main_calibrate([str(paths.SHIPPED_RECORDING), *LABELS, "--out", str(folder)]) == 0
    return folder


def test_calibrate_writes_cameras_for_other_programs(out):
    rig = StereoRig.load(out / "rig.json")
    storage = cv2.FileStorage(str(out / "left.yml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("projection_matrix").mat()[:2], rig.left.matrix)
    assert "projection_matrix" in (out / "right_camera_info.yaml").read_text()
    told = json.loads((out / "calibration.json").read_text())
    assert told["verdict"] in ("trustworthy", "doubtful") and told["rows"] == 102
    rows = (out / "landmarks.csv").read_text().splitlines()
    assert len(rows) == 103 and rows[1].startswith("0,base,")


def test_camera_files_of_an_earlier_run_do_not_pass_for_this_ones(tmp_path):
    c = simulate_correspondences(60, rng=np.random.default_rng(0))
    found = calibrate(c.x_mm, [c.u_left, c.u_right], model="zero_skew+distance+radial", image_size_px=(1920, 1080))
    (tmp_path / "left_camera_info.yaml").write_text("of cameras without distortion, earlier")
    commands._write_rig(tmp_path, found.rig, SimpleNamespace(image_size_px=(1920, 1080)))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["left.yml", "rig.json", "right.yml"]


def test_frames_calibrate_a_part_on_its_own(out, tmp_path, monkeypatch, capsys):
    """What lies outside is not looked at; its cameras are no others' frames'."""
    monkeypatch.setattr(paths, "RUNS", tmp_path)
    argv = [str(paths.SHIPPED_RECORDING), *LABELS]
    assert commands.main_calibrate([*argv, "--frames", ":17"]) == 0
    results = tmp_path / f"{paths.SHIPPED_RECORDING.name}-0-17"
    rows = (results / "landmarks.csv").read_text().splitlines()[1:]
    assert {int(row.split(",")[0]) for row in rows} == set(range(17))
    assert json.loads((results / "calibration.json").read_text())["frames"] == [0, 17]
    assert np.abs(StereoRig.load(results / "rig.json").left.matrix - StereoRig.load(out / "rig.json").left.matrix).max() > 0
    folder = str(paths.SHIPPED_RECORDING.resolve())
    assert [commands._results_of_rig(results / "rig.json", frame)[0] for frame in (0, 16, 17)] == [folder, folder, ""]
    with pytest.raises(SystemExit):
        commands.main_reconstruct([*argv, "--frames", "5:9", "--frame", "9"])
    assert "--frame: choose one of frames 5 to 8." in capsys.readouterr().err


def test_register_finds_the_cameras_where_they_are(out, tmp_path, capsys):
    """What an earlier run left there is not said to be written now."""
    (tmp_path / "rig.json").write_text("{}")
    assert commands.main_register(
        [str(paths.SHIPPED_RECORDING), *LABELS, "--rig", str(out / "rig.json"), "--out", str(tmp_path)]
    ) == 0  # fmt: skip
    told = json.loads((tmp_path / "registration.json").read_text())
    np.testing.assert_allclose(told["rotation"], np.eye(3), atol=0.02)
    said = capsys.readouterr().out
    assert told["median_epipolar_px"] < 2 and "Verdict:" in said and ": moved_left.yml, " in said
    assert " rig.json" not in said and (tmp_path / "rig.json").exists()
    assert StereoRig.load(tmp_path / "moved_rig.json").left.matrix.shape == (2, 4)


def test_register_knows_the_offsets_that_the_calibration_removed(tmp_path, monkeypatch, capsys):
    """Landmarks that are seen 0.2 mm beside the robot's report, in directions of their own: no camera moved."""
    truth = Recording.open(paths.SHIPPED_RECORDING)
    offset_mm = np.array([[0.2, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, -0.1, 0.2]])
    rows = of_recording(truth, truth.truth.u_left, truth.truth.u_right)
    beside = with_offsets(rows, LandmarkOffsets(-offset_mm, np.zeros((3, 3)), 0.1, 0.0))
    monkeypatch.setattr(commands, "_labelled", lambda recording: beside)
    folder = [str(paths.SHIPPED_RECORDING), *LABELS, "--out", str(tmp_path)]
    assert commands.main_calibrate([*folder, "--force"]) == 0
    assert np.abs(json.loads((tmp_path / "calibration.json").read_text())["landmark_offsets_mm"]).max() > 0.05
    assert commands.main_register([*folder, "--rig", str(tmp_path / "rig.json")]) == 0
    said = capsys.readouterr().out
    moved_mm = float(said.split("moved by ")[1].split(" mm")[0])
    assert "with the calibration's error." in said
    assert moved_mm < 0.03 and "no_common_motion" not in (tmp_path / "registration.json").read_text()
    told = [json.loads((tmp_path / "registration.json").read_text())]
    assert commands.main_register([*folder, "--rig", str(tmp_path / "moved_rig.json")]) == 0
    assert "by these detections alone, without the calibration's error." in capsys.readouterr().out
    told.append(json.loads((tmp_path / "registration.json").read_text()))
    assert np.trace(told[0]["covariance"]) > 1.2 * np.trace(told[1]["covariance"])


def test_register_writes_no_cameras_under_a_red_verdict(out, tmp_path, capsys):
    """A rig of another zoom; what an earlier run left there stays."""
    rig, argv = StereoRig.load(out / "rig.json"), [str(paths.SHIPPED_RECORDING), *LABELS, "--out", str(tmp_path)]
    StereoRig(*(replace(camera, matrix=1.5 * camera.matrix) for camera in (rig.left, rig.right))).save(tmp_path / "rig.json")
    argv += ["--rig", str(tmp_path / "rig.json")]
    assert commands.main_register(argv) == 3
    assert {path.name for path in tmp_path.iterdir()} == {"rig.json", "verdict.json"}
    said = capsys.readouterr().out
    assert "no_common_motion" in said and "--force writes the results" in said and "moved by" not in said
    assert commands.main_register([*argv, "--force"]) == 0
    assert {"moved_rig.json", "registration.json"} <= {path.name for path in tmp_path.iterdir()}
    assert not (tmp_path / "verdict.json").exists() and "moved by" in capsys.readouterr().out


def test_a_rig_that_is_missing_or_for_images_of_another_size_is_refused_at_once(out, tmp_path, monkeypatch):
    """Before the detector looks at any frame."""
    monkeypatch.setattr(commands, "_data", lambda *_: pytest.fail("it detects"))
    argv = [str(paths.SHIPPED_RECORDING), *LABELS, "--out", str(tmp_path), "--rig"]
    shutil.copy(out / "rig.json", tmp_path)
    told = json.loads((out / "calibration.json").read_text())
    assert told["image_size_px"] == [1920, 1080]
    (tmp_path / "calibration.json").write_text(json.dumps(told | {"image_size_px": [1280, 720]}))
    for command in (commands.main_register, commands.main_reconstruct):
        with pytest.raises(FileNotFoundError, match=r"calibrate RECORDING` writes rig\.json"):
            command([*argv, str(tmp_path)])
        with pytest.raises(ValueError, match=r"rig\.json: its cameras are for images of 1280 x 720 px, .* 1920 x 1080 px"):
            command([*argv, str(tmp_path / "rig.json")])


def test_register_says_where_no_motion_explains_the_landmarks(out):
    """A rig of another zoom, or of another microscope."""
    rig = StereoRig.load(out / "rig.json")
    other = StereoRig(*(replace(camera, matrix=1.1 * camera.matrix) for camera in (rig.left, rig.right)))
    recording = Recording.open(paths.SHIPPED_RECORDING)
    rows = of_recording(recording, recording.annotations.u_left, recording.annotations.u_right)
    found = SimpleNamespace(data=rows, calibration=SimpleNamespace(pair=rig, offsets=None))
    assert commands._common_motion(rig, found, None).reasons == ()
    (reason,) = commands._common_motion(other, found, None).reasons
    assert reason.name == "no_common_motion" and reason.level == "not trustworthy" and "--rig" in reason.cure


def test_reconstruct_writes_surface_points_and_the_rectified_pair(out, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(commands, "save_mesh", lambda mesh, path: path.write_bytes(b"glTF"))  # Open3D needs system libraries
    monkeypatch.setattr(commands, "save_points", lambda path, x_mm, colours: path.write_bytes(b"ply"))
    argv = [str(paths.SHIPPED_RECORDING), *LABELS, "--setting", "fast", "--frame", "2", "--out", str(tmp_path)]
    assert commands.main_reconstruct([*argv, "--rig", str(out / "rig.json")]) == 0
    told = json.loads((tmp_path / "reconstruction.json").read_text())
    assert told["frame"] == 2 and told["points"] > 500 and f"Frame 2: {told['points']} points" in capsys.readouterr().out
    calibrated = json.loads((out / "calibration.json").read_text())  # from this recording: its verdict holds
    assert (told["verdict"], told["reasons"]) == (calibrated["verdict"], calibrated["reasons"])
    left, right = (cv2.imread(str(tmp_path / f"rectified_{side}.png")) for side in ("left", "right"))
    matrices = json.loads((tmp_path / "rectification.json").read_text())
    assert left.shape == right.shape
    truth = Recording.open(paths.SHIPPED_RECORDING).truth  # disparities of the retina are positive, as networks expect
    x_mm = np.load(paths.SHIPPED_RECORDING / "truth" / "surface.npz")["x_mm"].reshape(-1, 3)[::50]
    sides = zip((matrices["left_from_canvas"], matrices["right_from_canvas"]), truth.rig.project(x_mm), strict=True)
    a, b = (np.linalg.solve(np.array(m)[:, :2], (u - np.array(m)[:, 2]).T).T for m, u in sides)
    disparity_px, (low, high) = a[:, 0] - b[:, 0], matrices["disparity_range_px"]
    assert np.abs(a[:, 1] - b[:, 1]).max() < 2 and low == 0 < disparity_px.min() and disparity_px.max() < high
    depth_mm = x_mm @ truth.rig.left.viewing_direction
    told_px = matrices["displacement_px_per_mm"] * (matrices["reference_depth_mm"] - depth_mm)
    assert np.abs(told_px - disparity_px).max() < 2
    assert {"surface.glb", "points.ply", "depth.tiff"} <= {path.name for path in tmp_path.iterdir()}
    recording = Recording.open(paths.SHIPPED_RECORDING)
    x, y = np.rint(recording.annotations.u_left[2, 0]).astype(int)  # the tool hides the surface
    depth_mm = cv2.imread(str(tmp_path / "depth.tiff"), cv2.IMREAD_UNCHANGED)
    assert np.isnan(depth_mm[y, x]) and np.isfinite(depth_mm).mean() > 0.8


def test_a_tool_without_labels_is_masked_where_the_robot_reports_it(out, tmp_path, monkeypatch, capsys):
    """Or the verdict says that it may be in the surface."""
    recording = Recording.open(paths.SHIPPED_RECORDING)
    rows = of_recording(recording, recording.truth.u_left, recording.truth.u_right)
    for u in (rows.u_left, rows.u_right):
        u[rows.frame == 2] = np.nan
    monkeypatch.setattr(commands, "_labelled", lambda recording: rows)
    monkeypatch.setattr(commands, "save_mesh", lambda mesh, path: None)
    monkeypatch.setattr(commands, "save_points", lambda path, x_mm, colours: None)
    tools_px, real = [], commands.reconstruct

    def reconstruct(*images, u_landmarks, setting):
        tools_px.append(np.array(u_landmarks))
        return real(*images, u_landmarks=u_landmarks, setting="fast")  # quality takes its time

    monkeypatch.setattr(commands, "reconstruct", reconstruct)
    argv = [str(recording.folder), *LABELS, "--frame", "2", "--out", str(tmp_path), "--rig", str(out / "rig.json")]
    assert commands.main_reconstruct(argv) == 0
    assert "tool_not_masked" not in capsys.readouterr().out
    assert np.abs(tools_px[0] - [recording.truth.u_left[2], recording.truth.u_right[2]]).max() < 10
    rows.x_mm[rows.frame == 2] = np.nan  # the robot does not know either
    monkeypatch.setattr(commands, "AMBIGUOUS", -1.0)
    assert commands.main_reconstruct(argv) == 0
    assert "The surface may include the tool" in capsys.readouterr().out
    named = {reason["name"] for reason in json.loads((tmp_path / "reconstruction.json").read_text())["reasons"]}
    assert {"tool_not_masked", "ambiguous_texture"} <= named


def test_a_rig_has_the_verdict_of_the_recording_that_it_is_of(out, tmp_path, capsys):
    """Also one that `register` moved; of another recording, or by another name, nothing tests it."""
    recording, results = Recording.open(paths.SHIPPED_RECORDING), tmp_path / "results"
    results.mkdir()
    told = json.loads((out / "calibration.json").read_text())
    (results / "calibration.json").write_text(json.dumps(told | {"recording": str(tmp_path / "another")}))
    red = {"name": "aspect", "level": "not trustworthy", "text": "Oblong.", "cure": "Mend it."}
    (results / "registration.json").write_text(json.dumps(told | {"reasons": [red]}))
    for name in ("rig.json", "moved_rig.json", "refined_rig.json"):
        shutil.copy(out / "rig.json", results / name)

    def verdict(rig, force=False):
        a = SimpleNamespace(rig=rig, recording=recording.folder, frame=0, landmarks="annotations", force=force, earlier={})
        found, _, told, _ = commands._calibrated(a, recording, tmp_path)
        return found is not None, told.level, [reason.name for reason in told.reasons]

    assert verdict(out / "rig.json") == (True, told["verdict"], [reason["name"] for reason in told["reasons"]])
    for name in ("rig.json", "refined_rig.json"):
        assert verdict(results / name) == (True, "doubtful", ["rig_given"])
    assert verdict(results / "moved_rig.json") == (False, "not trustworthy", ["aspect"])
    assert (tmp_path / "verdict.json").exists() and "--force writes the results" in capsys.readouterr().out
    assert verdict(results / "moved_rig.json", force=True) == (True, "not trustworthy", ["aspect"])
    assert not (tmp_path / "verdict.json").exists()


def test_reconstruct_without_open3d_writes_the_rest(out, tmp_path, monkeypatch, capsys):
    def missing(*_, **__):
        raise ImportError("Open3D does not load (libusb). On Debian and Ubuntu: apt-get install libusb-1.0-0")

    monkeypatch.setattr(export, "open3d", missing)
    argv = [str(paths.SHIPPED_RECORDING), *LABELS, "--setting", "fast", "--frame", "2", "--out", str(tmp_path)]
    assert commands.main_reconstruct([*argv, "--rig", str(out / "rig.json")]) == 0
    assert "Without surface.glb and points.ply: Open3D does not load" in capsys.readouterr().out
    found = {path.name for path in tmp_path.iterdir()}
    assert {"points.csv", "depth.tiff", "rectified_left.png", "refined_rig.json", "reconstruction.json"} <= found
    assert not {"surface.glb", "points.ply"} & found
    u_left, u_right, x_mm, sd_mm = np.split(np.loadtxt(tmp_path / "points.csv", delimiter=",", skiprows=1), [2, 4, 7], axis=1)
    assert len(x_mm) == json.loads((tmp_path / "reconstruction.json").read_text())["points"]
    off_mm = np.abs(StereoRig.load(tmp_path / "refined_rig.json").triangulate(u_left, u_right).x_mm - x_mm)  # unweighted
    assert np.median(off_mm) < 0.002 and off_mm.max() < 0.1 and 0 < sd_mm.min() and np.median(sd_mm) < 0.1


def test_reconstruct_names_the_cause_if_the_cameras_do_not_fit_the_images(out, tmp_path, monkeypatch):
    def misfit(*_, **__):
        raise RigMisfitError("rig: it does not fit the images.")

    monkeypatch.setattr(commands, "reconstruct", misfit)
    shutil.copy(out / "rig.json", tmp_path / "another.json")
    argv = [str(paths.SHIPPED_RECORDING), *LABELS, "--frame", "2", "--out", str(tmp_path)]
    said = r"does not fit the images\. The recording's verdict says: .* nothing here shows .* Run: "
    with pytest.raises(ValueError, match=said):
        commands.main_reconstruct([*argv, "--rig", str(tmp_path / "another.json")])


def test_a_red_verdict_writes_nothing_but_itself(tmp_path, capsys):
    """Landmarks of other frames: no cameras explain them."""
    whole = thinned(foreign.shipped(), 5)
    labels = replace(whole.labels, u_left=whole.labels.u_left[::-1], visibility_left=whole.labels.visibility_left[::-1])
    source = replace(whole, labels=labels)
    makers = foreign.side_by_side, foreign.robot_csv, foreign.labels_coco
    folder, mapping = source_of(tmp_path, source, *makers)
    argv = [str(folder), "--map", str(mapping), "--out", str(tmp_path / "eye")]
    assert commands.main_import(argv) == 0
    assert "Verdict: not trustworthy" in capsys.readouterr().out
    results = tmp_path / "results"
    results.mkdir(), (results / "rig.json").write_text("{}")
    assert commands.main_calibrate([str(tmp_path / "eye"), *LABELS, "--out", str(results)]) == 3
    assert {path.name for path in results.iterdir()} == {"verdict.json", "rig.json"}
    said = capsys.readouterr().out
    assert f"Nothing else was written. Results of an earlier run are in {results}." in said and "--force" not in said


def test_cameras_of_a_finite_distance_are_calibrated_as_such(tmp_path, capsys, monkeypatch):
    """Unasked; as affine ones, if somebody insists, they are refused with the reason."""
    microscope = Microscope(pixels_per_mm=(20.0, 20.0), image_size_px=(384, 216), inverse_distance_per_mm=1 / 50)
    design = Design(Eye(texture_px=128), microscope=microscope, motion="sweep", duration_s=20.0, click_px=0.1)
    simulate(tmp_path / "eye", design, n_frames=24, progress=False)
    argv = [str(tmp_path / "eye"), *LABELS, "--out", str(tmp_path / "out")]
    assert commands.main_calibrate([*argv, "--model", "zero_skew"]) == 3 and "finite_distance" in capsys.readouterr().out
    assert commands.main_calibrate(argv) == 0
    said = capsys.readouterr().out
    assert "working distance" in said and "finite_distance" not in said
    assert json.loads((tmp_path / "out" / "calibration.json").read_text())["model"] == "near_affine"
    (tmp_path / "out" / "depth.tiff").write_bytes(b"of affine cameras, earlier")
    monkeypatch.setattr(commands, "save_mesh", lambda mesh, path: None)
    monkeypatch.setattr(commands, "save_points", lambda path, x_mm, colours: None)
    assert commands.main_reconstruct([*argv, "--setting", "fast"]) == 0
    assert 0 < json.loads((tmp_path / "out" / "reconstruction.json").read_text())["depth_sd_of_cameras_mm"] < 1
    assert not (tmp_path / "out" / "depth.tiff").exists(), "it would pass for this run's"
    points = np.genfromtxt(tmp_path / "out" / "points.csv", delimiter=",", names=True)
    x, y = (np.rint(points[name]).astype(int) for name in ("left_x_px", "left_y_px"))
    surface_mm = cv2.imread(str(tmp_path / "out" / "surface.tiff"), cv2.IMREAD_UNCHANGED)[y, x, ::-1]  # OpenCV: B, G, R
    off_mm = surface_mm - np.stack([points[f"{axis}_mm"] for axis in "xyz"], axis=1)
    assert np.abs(np.nanmedian(off_mm, axis=0)).max() < 0.1 and np.isfinite(off_mm).mean() > 0.8
    with pytest.raises(ValueError, match="unknown model 'near'; take one of .*near_affine"):
        commands.main_calibrate([*argv, "--model", "near"])


@pytest.mark.parametrize(("command", "argv", "said"), [
    ("reconstruct", ["--rig", "rig.json", "--model", "near_affine"], "--model, --frames: with --rig no camera is calibrated"),
    ("reconstruct", ["--rig", "rig.json", "--frames", "0:9"], "--model, --frames: with --rig no camera is calibrated"),
    ("calibrate", [*LABELS, "--weights", "mine.safetensors"], "--weights: with --landmarks annotations no detector is used"),
    ("detect", ["--force"], "unrecognized arguments: --force"),
    ("register", ["--rig", "rig.json", "--setting", "fast"], "unrecognized arguments: --setting"),
    ("import", ["--guess", "--map", "map.toml", "--overwrite"], "--guess writes a mapping only"),
])  # fmt: skip
def test_an_option_that_cannot_act_is_refused(command, argv, said, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        getattr(commands, f"main_{command}")([str(paths.SHIPPED_RECORDING), *argv, "--out", str(tmp_path)])
    assert ended.value.code == 2 and said in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_results_of_another_recording_of_that_name_stay(tmp_path, monkeypatch):
    """patient1/recording and patient2/recording; a recording that is gone has no claim."""
    monkeypatch.setattr(paths, "RUNS", tmp_path / "runs")
    other = tmp_path / "other" / paths.SHIPPED_RECORDING.name
    other.mkdir(parents=True)
    for name, call in ((other.name, partial(commands.main_detect, [*LABELS, str(paths.SHIPPED_RECORDING)])),
                       (f"check-{other.name}", partial(check.main, [str(paths.SHIPPED_RECORDING)]))):  # fmt: skip
        folder = paths.results_folder(name, other)
        with pytest.raises(FileExistsError, match=rf"{name}: it has the results of another recording, {other}\. .*--out"):
            call()
        assert [path.name for path in folder.iterdir()] == [paths.RECORDING_NOTE]
    other.rmdir()
    assert paths.results_folder(other.name, paths.SHIPPED_RECORDING) == tmp_path / "runs" / other.name


def test_guess_writes_a_mapping_once(tmp_path, capsys):
    folder, mapping = source_of(tmp_path, thinned(foreign.shipped(), 40), foreign.side_by_side, foreign.robot_csv)
    path = tmp_path / "guessed.toml"
    assert commands.main_import([str(folder), "--guess", "--map", str(path)]) == 0
    assert path.read_text("utf-8") in capsys.readouterr().out
    with pytest.raises(FileExistsError, match=r"guessed\.toml: exists already"):
        commands.main_import([str(folder), "--guess", "--map", str(path)])
    assert not any(folder.glob("*.toml")) and mapping.is_file()


def test_annotate_opens_a_page_that_runs(tmp_path, monkeypatch):
    """Where the detector finds nothing, the page still lets one label."""
    makers = foreign.side_by_side, foreign.robot_csv
    folder, mapping = source_of(tmp_path, thinned(foreign.shipped(), 40), *makers)
    recording = tmp_path / 'my "first" recording #2'
    commands.main_import([str(folder), "--map", str(mapping), "--out", str(recording)])
    opened = []
    monkeypatch.setattr(commands.subprocess, "call", lambda argv, cwd: opened.append(argv[-1]) or 0)
    monkeypatch.setattr(paths, "RUNS", tmp_path / "runs")
    assert commands.main_annotate([str(recording)]) == 0
    (page,) = (tmp_path / "runs").iterdir()
    assert opened == [f"--LabApp.default_url=/lab/tree/runs/{quote(page.name)}"] and "#" not in opened[0]
    (cell,) = nbformat.read(page, as_version=4).cells
    monkeypatch.setattr(Detector, "load", lambda *_: lambda images: Landmarks.none(len(images)))
    names: dict = {}
    exec(compile(cell.source, page.name, "exec"), names)
    names["annotator"].mark("left", 2, "base", (20.0, 30.0))
    assert Recording.open(recording).annotations.u_left[2, 0].tolist() == [20, 30]
    other = tmp_path / "other" / recording.name  # of the same name: it has a page of its own
    shutil.copytree(recording, other)
    assert commands.main_annotate([str(other)]) == 0
    assert page.is_file() and len(list((tmp_path / "runs").iterdir())) == 2


def test_detect_refuses_landmarks_that_the_detector_does_not_know(tmp_path):
    recording = tmp_path / "probe"
    folder, mapping = source_of(tmp_path, thinned(foreign.shipped(), 40), foreign.side_by_side, foreign.robot_csv)
    text = mapping.read_text("utf-8").replace("tip_2 =", "elbow =")
    mapping.write_text('landmarks = ["base", "tip_1", "elbow"]\n' + text, "utf-8")
    commands.main_import([str(folder), "--map", str(mapping), "--out", str(recording)])
    assert Recording.open(recording).skeleton == ("base", "tip_1", "elbow")
    with pytest.raises(ValueError, match="give --landmarks annotations"):
        commands.main_detect([str(recording), "--out", str(tmp_path)])
