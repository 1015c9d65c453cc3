"""The annotator without a browser: what it writes, suggests and puts first."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest

from lib.cameras import AffineCamera, NearAffineCamera, StereoRig
from lib.correspondences import of_recording
from lib.recordings import Annotations, Annotator, Recording, RecordingWriter
from lib.training.samples import labelled_images

SIZE, N = (64, 48), 5
RIG = StereoRig(AffineCamera([[5, 0, 0, 30], [0, 5, 0, 20]]), AffineCamera([[5, 0, 0.5, 33], [0, 5, 0.1, 21]]))
TOOL_MM = np.array([[0, 0, 0], [3, 1, 0.4], [3, -1, 0.2]], float)


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """Five frames, in which the tool moves by 0.4 mm a frame, without a label."""
    folder = tmp_path_factory.mktemp("annotator") / "mine"
    with RecordingWriter(folder, name="mine", fps=25, image_size_px=SIZE, suffix=".png") as writer:
        for k in range(N):
            writer.add(*np.full((2, SIZE[1], SIZE[0], 3), 10 * k, np.uint8))
        time_s = np.linspace(0, 0.2, 21)
        writer.kinematics(time_s, TOOL_MM + np.array([10, 0, 0]) * time_s[:, None, None])
    return folder


@pytest.fixture
def folder(template, tmp_path):
    return shutil.copytree(template, tmp_path / "mine")


def labels(folder) -> Annotations:
    return Recording.open(folder).annotations


def detected(recording, off_px=(), missed=()):
    """What a detector finds that is 0.1 px off, and in some frames farther, or blind."""
    told = RIG.project(recording.landmarks_mm().reshape(-1, 3))
    u = np.reshape(told, (2, len(recording), 3, 2)) + 0.1
    for frame, px in off_px:
        u[0, frame, 1] += px
    u[:, list(missed)] = np.nan
    return of_recording(recording, *u)


def test_frames_without_leading_zeros_keep_their_names(folder):
    Annotator(Recording.open(folder)).mark("left", 3, "base", (10.0, 20.0))
    for path in folder.glob("*/*.png"):
        path.rename(path.with_stem(str(int(path.stem))))
    Annotator(Recording.open(folder)).mark("left", 3, "tip_1", (12.0, 20.0))  # the entry names left/000003.png
    Annotator(Recording.open(folder)).mark("right", 3, "base", (10.0, 20.0))
    told = json.loads((folder / "annotations.json").read_text(encoding="utf-8"))["images"]
    assert [one["file_name"] for one in told] == ["left/000003.png", "right/3.png"]
    assert labels(folder).visibility_left[3].tolist() == [2, 2, 0]


def test_each_mark_is_in_the_file_at_once(folder):
    annotator = Annotator(Recording.open(folder))
    annotator.mark("left", 2, "base", (10.25, 20.5))
    annotator.mark("right", 2, "tip_1", (63.5, -0.5), 1)
    annotator.mark("right", 2, "tip_2")
    found = labels(folder)
    assert found.u_left[2, 0].tolist() == [10.25, 20.5] and found.u_right[2, 1].tolist() == [63.5, -0.5]
    assert found.visibility_left[2].tolist() == [2, 0, 0] and found.visibility_right[2].tolist() == [0, 1, -1]
    assert np.isfinite(found.u_left).sum() == 2, "nothing else is labelled"
    content = json.loads((folder / "annotations.json").read_text())
    assert content["images"][0]["file_name"] == "left/000002.png"
    assert [entry["num_keypoints"] for entry in content["annotations"]] == [1, 1]
    assert [entry.get("absent") for entry in content["annotations"]] == [None, ["tip_2"]]


def test_undo_and_redo_walk_through_the_steps(folder):
    annotator = Annotator(Recording.open(folder))
    assert annotator.undo() is None
    annotator.mark("left", 1, "base", (1, 2))
    annotator.handle({"do": "mark", "marks": [["left", 1, 0, 5, 6, 2], ["right", 1, 2, None, None, -1]], "frame": 1})
    assert annotator.undo() == 1 and labels(folder).u_left[1, 0].tolist() == [1, 2]
    assert labels(folder).visibility_right[1, 2] == 0
    assert annotator.undo() == 1 and not labels(folder).visibility_left.any()
    assert annotator.redo() == 1 and annotator.redo() == 1 and annotator.redo() is None
    assert labels(folder).u_left[1, 0].tolist() == [5, 6] and labels(folder).visibility_right[1, 2] == -1
    annotator.undo()
    annotator.mark("left", 3, "base", (7, 7))
    assert annotator.redo() is None, "a new change ends what could be done again"


def test_what_others_wrote_stays(folder):
    """Another program's images, keypoints, keys and later labels, and a category with more names in another order."""
    names = ["tip_2", "shaft", "tip_1", "base"]
    keypoints = [1, 1, 2, 9, 9, 2, 3, 3, 1, 4, 4, 2]
    content = {
        "licenses": ["ours"], "categories": [{"id": 9, "keypoints": ["nose"]}, {"id": 4, "keypoints": names}],
        "images": [{"id": 7, "file_name": "left/000001.jpg", "note": "blurred"}],
        "annotations": [{"id": 3, "image_id": 7, "category_id": 4, "keypoints": keypoints, "author": "Ann"}],
    }  # fmt: skip
    path = folder / "annotations.json"
    path.write_text(json.dumps(content))
    annotator = Annotator(Recording.open(folder))
    content["annotations"][0]["author"] = "Bea"
    path.write_text(json.dumps(content))  # while the annotator is open
    annotator.mark("left", 1, "tip_1", (30, 31))
    annotator.mark("left", 0, "base", (8, 8))
    now = json.loads(path.read_text())
    assert now["licenses"] == ["ours"] and now["images"][0]["note"] == "blurred"
    assert now["annotations"][0]["author"] == "Bea"
    assert now["annotations"][0]["keypoints"] == [1, 1, 2, 9, 9, 2, 30, 31, 2, 4, 4, 2]
    assert now["annotations"][0]["bbox"] == [1, 1, 29, 30]
    assert labels(folder).u_left[0, 0].tolist() == [8, 8] and labels(folder).u_left[1, 2].tolist() == [1, 1]


def test_an_entry_keeps_the_order_of_its_own_category(folder):
    """Two categories name the same landmarks in different orders; the entries of another program may lack ids."""
    names = ["tip_2", "tip_1", "base"]
    content = {
        "categories": [{"id": 1, "keypoints": names[::-1]}, {"id": 2, "keypoints": names}],
        "images": [{"id": 7, "file_name": "left/000001.png"}],
        "annotations": [{"image_id": 7, "category_id": 2, "keypoints": [1, 1, 2, 2, 2, 2, 3, 3, 1]}],
    }
    path = folder / "annotations.json"
    path.write_text(json.dumps(content))
    annotator = Annotator(Recording.open(folder))
    annotator.mark("left", 1, "tip_1", (30, 31))
    annotator.mark("right", 1, "base", (5, 5))
    now = json.loads(path.read_text())["annotations"]
    assert now[0]["keypoints"] == [1, 1, 2, 30, 31, 2, 3, 3, 1] and now[1]["category_id"] == 1
    assert labels(folder).u_left[1].tolist() == [[3, 3], [30, 31], [1, 1]]
    assert labels(folder).u_right[1, 0].tolist() == [5, 5]


@pytest.mark.parametrize(
    ("mark", "told"),
    [(("left", 0, 0, 64, 1, 2), "outside"), (("up", 0, 0, 1, 1, 2), "'up'"), (("left", N, 0, 1, 1, 2), f"frame {N}"),
     (("left", 0, 3, 1, 1, 2), "landmark 3"), (("left", 0, 0, None, 1, 2), "outside"),
     (("left", 0, 0, 1, 1, 7), "visibility 7")],
)  # fmt: skip
def test_what_cannot_be_is_refused_and_nothing_written(folder, mark, told):
    annotator = Annotator(Recording.open(folder))
    answer, images = annotator.handle({"do": "mark", "id": 4, "marks": [["left", 0, 1, 3, 3, 2], list(mark)], "frame": 0})
    assert told in answer["error"] and answer["id"] == 4 and not images
    assert not (folder / "annotations.json").exists() and annotator.undo() is None


def test_a_file_that_cannot_be_written_is_told(folder, monkeypatch):
    annotator = Annotator(Recording.open(folder))
    annotator.mark("left", 0, "base", (5, 5))
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    answer, _ = annotator.handle({"do": "mark", "id": 1, "marks": [["left", 0, 0, 9, 9, 2]], "frame": 0})
    assert "No space left" in answer["error"]
    assert labels(folder).u_left[0, 0].tolist() == [5, 5] and len(list(folder.glob("annotations*"))) == 1


def test_killed_while_it_writes_it_leaves_a_whole_file(folder):
    """A process marks without end and is killed; the file is whole and holds every mark that was told as written."""
    code = f"""
from lib.recordings import Annotator, Recording
annotator = Annotator(Recording.open({str(folder)!r}))
for k in range(10**6):
    annotator.mark("left", k % {N}, "base", (k % 60 + 0.5, k // 60 % 48))
    print(k, flush=True)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    told = [int(process.stdout.readline()) for _ in range(8)][-1]
    process.send_signal(signal.SIGKILL)
    process.wait()
    told = max([told, *(int(line) for line in process.stdout.read().split("\n")[:-1])])
    found = labels(folder).u_left[told % N, 0]
    assert np.round(found[0] - 0.5) + 60 * found[1] >= told


def test_robot_and_detector_suggest_and_lines_pass_through_what_the_right_image_shows(folder):
    recording = Recording.open(folder)
    annotator = Annotator(recording)
    assert annotator.handle({"do": "show", "frame": 1})[0]["robot"][0][0] == [None, None]
    annotator.know(rig=RIG, detected=detected(recording))
    left, right = RIG.project(recording.landmarks_mm()[1])
    annotator.mark("left", 1, "tip_1", tuple(left[1]))
    answer, _ = annotator.handle({"do": "show", "frame": 1})
    np.testing.assert_allclose(answer["robot"], [left, right], atol=1e-9)
    np.testing.assert_allclose(answer["detector"], np.array([left, right]) + 0.1, atol=1e-9)
    assert [line is None for line in answer["lines"]] == [True, False, True]
    points = np.array(answer["lines"][1])
    assert np.abs(RIG.epipolar_distance(np.tile(left[1], (len(points), 1)), points)).max() < 1e-9
    assert distance_to(points, right[1]) < 1e-9


def distance_to(line: np.ndarray, u: np.ndarray) -> float:
    """From a pixel to the polyline, or its first segment drawn on."""
    a, b = line[:-1], line[1:]
    t = np.clip(((u - a) * (b - a)).sum(1) / ((b - a) ** 2).sum(1), 0, 1)[:, None]
    return float(np.linalg.norm(a + t * (b - a) - u, axis=1).min())


def test_lines_of_cameras_with_a_working_distance(folder):
    centre = {"inverse_distance_per_mm": 1 / 150, "centre_px": (32, 24)}
    rig = StereoRig(*(NearAffineCamera(camera.matrix, **centre) for camera in (RIG.left, RIG.right)))
    recording = Recording.open(folder)
    annotator = Annotator(recording, rig=rig)
    left, right = rig.project(recording.landmarks_mm()[2])
    annotator.mark("left", 2, "base", tuple(left[0]))
    line = np.array(annotator.handle({"do": "show", "frame": 2})[0]["lines"][0])
    assert np.isfinite(line).all() and distance_to(line, right[0]) < 0.01


def test_the_frames_in_which_detector_and_robot_disagree_most_come_first(folder):
    recording = Recording.open(folder)
    annotator = Annotator(recording, rig=RIG, detected=detected(recording, off_px=[(3, 4.0), (1, 9.0)], missed=[4]))
    length = np.median(np.linalg.norm(TOOL_MM[1:] - TOOL_MM[0], axis=1)) * 5
    np.testing.assert_allclose(annotator.usefulness[[1, 3]], [9 * 2**0.5, 4 * 2**0.5], rtol=0.05)
    assert annotator.usefulness[4] == pytest.approx(length, rel=0.1)
    order = [annotator.handle({"do": "hello"})[0]["frame"]]
    for _ in range(3):
        order.append(annotator.handle({"do": "next", "frame": order[-1]})[0]["frame"])
    assert order[:3] == [4, 1, 3]


def test_labelled_frames_do_not_come_again_and_the_farthest_from_any_label_comes_first(folder):
    annotator = Annotator(Recording.open(folder))
    for side in ("left", "right"):
        for name in annotator.recording.skeleton:
            annotator.mark(side, 0, name, (5, 5))
    assert annotator.complete.tolist() == [True] + [False] * (N - 1) and "1 of 5 frames" in repr(annotator)
    assert annotator.next_frame(0) == 4
    order = [4]
    for _ in range(3):
        order.append(annotator.next_frame(order[-1]))
    assert order[1] == 2 and sorted(order) == [1, 2, 3, 4]
    assert annotator.next_frame(order[-1]) in order[:3], "all were visited: it begins again"


def test_a_file_of_other_keypoints_gets_a_category_of_ours(folder):
    path = folder / "annotations.json"
    path.write_text(json.dumps({"categories": [{"id": 2, "keypoints": ["nose"]}], "images": [], "annotations": []}))
    annotator = Annotator(Recording.open(folder))
    annotator.mark("right", 4, "base", (1, 1))
    assert [one["id"] for one in json.loads(path.read_text())["categories"]] == [2, 3]
    assert labels(folder).u_right[4, 0].tolist() == [1, 1]


def test_other_landmark_sets(tmp_path):
    names = ["hub", "left_end", "right_end", "tail"]
    with RecordingWriter(tmp_path / "r", name="r", fps=25, image_size_px=SIZE, skeleton=names) as writer:
        writer.add(*np.zeros((2, SIZE[1], SIZE[0], 3), np.uint8))
        writer.kinematics([0, 0.04], np.arange(12).reshape(4, 3) + np.zeros((2, 1, 1)))
    annotator = Annotator(Recording.open(tmp_path / "r"), rig=RIG)
    annotator.mark("right", 0, "tail", (3, 4))
    assert labels(tmp_path / "r").u_right[0, 3].tolist() == [3, 4]
    assert len(annotator.handle({"do": "hello"})[0]["marks"][0]) == 4


def test_images_come_in_their_own_size_and_colour(folder):
    answer, images = Annotator(Recording.open(folder)).handle({"do": "show", "frame": 3})
    for image in images:
        decoded = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
        assert decoded.shape == (SIZE[1], SIZE[0], 3) and abs(int(decoded[5, 5, 0]) - 30) <= 1
    assert answer["frame"] == 3 and json.loads(json.dumps(answer, allow_nan=False)) == json.loads(json.dumps(answer))


def test_an_absent_landmark_trains_as_absent_and_an_open_one_as_unknown(folder):
    annotator = Annotator(Recording.open(folder))
    annotator.mark("left", 0, "base", (5, 5))
    annotator.mark("left", 0, "tip_1")
    image = next(iter(labelled_images(Recording.open(folder))))
    assert image.visibility.tolist() == [2, 0, 1] and np.isnan(image.u[1:]).all()


def test_the_page_is_a_widget_that_answers(folder):
    pytest.importorskip("anywidget")
    annotator = Annotator(Recording.open(folder))
    sent = []
    annotator.widget.send = lambda content, buffers=None: sent.append((content, buffers))
    annotator.widget._handle_custom_msg({"do": "hello", "id": 1}, [])
    assert sent[0][0]["landmarks"] == ("base", "tip_1", "tip_2") and len(sent[0][1]) == 2
    annotator.know(rig=RIG)
    assert sent[1][0] == {"renew": True}
    assert "application/vnd.jupyter.widget-view+json" in annotator._repr_mimebundle_()[0]
