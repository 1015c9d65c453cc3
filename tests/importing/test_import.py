"""The shipped recording made foreign and imported again: the same landmarks, kinematics, clock and calibration."""

import hashlib
import json
import re
import tomllib
import warnings
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from lib import paths
from lib.calibration import calibrate
from lib.calibration.offsets import tool_axes
from lib.correspondences import LANDMARKS, of_recording
from lib.geometry import RigidTransform
from lib.importing import guess_mapping, import_recording, importer, logs, read_mapping
from lib.recordings import Annotations, Kinematics, Recording
from lib.recordings.frames import Frames
from tests.importing import foreign

HINGE = (
    "[tool]\nlandmarks_mm = { base = [0, 0, 0] }\n"
    "hinge = { point_mm = [0, 0, 0], axis = [0, 0, 1], jaw_mm = [2.988, 0, 0] }\n"
)
FORMS = {
    "side by side": (foreign.side_by_side, foreign.robot_csv, foreign.labels_coco),
    "metres and semicolons": (foreign.images, foreign.robot_foreign_csv, foreign.labels_coco),
    "pose only": (foreign.images, lambda folder, source: foreign.robot_poses(folder, source) + HINGE, foreign.labels_coco),
    "ROS 2 bag": (foreign.images, foreign.robot_bag, foreign.labels_coco),
    "ROS 1 bag": (foreign.images, lambda folder, source: foreign.robot_bag(folder, source, 1), foreign.labels_coco),
    "DeepLabCut": (foreign.images, foreign.robot_csv, foreign.labels_deeplabcut),
    "CVAT": (foreign.images, foreign.robot_csv, foreign.labels_cvat),
    "Label Studio": (foreign.side_by_side, foreign.robot_csv, foreign.labels_label_studio),
    "SLEAP": (foreign.images, foreign.robot_csv, foreign.labels_sleap),
}


@pytest.fixture(scope="module")
def shipped():
    return foreign.shipped()


def source_of(tmp_path: Path, source: foreign.Shipped, *makers) -> tuple[Path, Path]:
    """A folder of foreign files and the mapping beside it."""
    folder, mapping = tmp_path / "my söurce", tmp_path / "map.toml"
    folder.mkdir()
    mapping.write_text('name = "eye"\nreadout_s = 0.015\n' + "".join(maker(folder, source) for maker in makers), "utf-8")
    return folder, mapping


def thinned(source: foreign.Shipped, every: int) -> foreign.Shipped:
    return replace(source, robot_s=source.robot_s[::every], x_mm=source.x_mm[::every])



def test_images_of_a_turned_camera_are_turned_back(tmp_path, shipped):
    """Black at the right and at the bottom makes the sizes equal, so pixels keep their coordinates."""
    small = replace(shipped, frames=shipped.frames[:3], time_s=shipped.time_s[:3])

    def turned(folder, source):
        text = foreign.images(folder, source)
        for path in (folder / "cam R").iterdir():
            cv2.imwrite(str(path), np.rot90(cv2.imread(str(path)), -1))  # clockwise
        return text + 'format = "png"\n'

    folder, mapping = source_of(tmp_path, small, turned, foreign.robot_csv)
    with pytest.raises(ValueError, match=r"differ in size .* set video\.rotate_left or video\.rotate_right"):
        import_recording(folder, mapping, tmp_path / "refused")
    given = mapping.read_text("utf-8")
    for left, right in ((0, 270), (90, 0), (180, 0)):  # the last one does not turn it back, so black is needed
        mapping.write_text(given.replace("[video]\n", f"[video]\nrotate_left = {left}\nrotate_right = {right}\n"), "utf-8")
        with warnings.catch_warnings(action="ignore"):  # three frames and a long log
            did = import_recording(folder, mapping, tmp_path / "eye", overwrite=True)["did"]
            frame = Recording.open(tmp_path / "eye").frames[1]
        assert any(f"turned clockwise by {left} degrees, right ones by {right};" in line for line in did)
        turns = -left // 90, -(right + 90) // 90
        expected = [np.rot90(image, turn) for image, turn in zip(small.frames[1], turns, strict=True)]
        size = np.max([image.shape for image in expected], axis=0)
        for image, own in zip((frame.left, frame.right), expected, strict=True):
            height, width = own.shape[:2]
            assert image.shape == tuple(size) and (image[:height, :width] == own).all()
            assert not image[height:].any() and not image[:, width:].any()
    for path in (folder / "cam R").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path))[:-20])
    with pytest.raises(ValueError, match="differ in size"):  # turned or not, these are no images of one pair
        import_recording(folder, mapping, tmp_path / "refused")
    mapping.write_text(f"{mapping.read_text('utf-8')}[labels]\nkind = 'coco'\nfile = 'labels.json'\n", "utf-8")
    with pytest.raises(ValueError, match="labels of images that are to be turned are not read"):
        read_mapping(mapping)


def content(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.rglob("*") if p.is_file()}


def rig_of(recording: Recording):
    rows = of_recording(recording, recording.annotations.u_left, recording.annotations.u_right)
    return calibrate(rows, image_size_px=recording.image_size_px).rig


@pytest.mark.parametrize("form", FORMS)
def test_a_foreign_form_comes_back(form, shipped, tmp_path):
    shipped = shipped if form == "metres and semicolons" else thinned(shipped, 5)  # a clock needs the whole log
    folder, mapping = source_of(tmp_path, shipped, *FORMS[form])
    before = content(folder)
    report = import_recording(folder, mapping, tmp_path / "eye")
    assert content(folder) == before
    recording = Recording.open(tmp_path / "eye")
    np.testing.assert_allclose(recording.frames.time_s, shipped.time_s, atol=1e-6)
    for side in ("left", "right"):  # NaN where the reduced image ends before the label
        ours, theirs = (getattr(labels, f"u_{side}") for labels in (recording.annotations, shipped.labels))
        np.testing.assert_allclose(ours, theirs, atol=0.05 / 8)  # 0.05 px of the full frame
    expected = foreign.posed(shipped)[2] if form == "pose only" else shipped.x_mm
    np.testing.assert_allclose(recording.kinematics.x_mm, expected, atol=1e-3)
    if report["clock"]:
        assert abs(report["clock"]["offset_s"] - foreign.CLOCK_S) < 5e-4
        assert recording.offset_s == pytest.approx(report["clock"]["offset_s"])
        assert report["clock"]["sd_s"] < 5e-4
    robot_s = recording.kinematics.time_s - recording.offset_s
    np.testing.assert_allclose(robot_s, shipped.robot_s, atol=5e-4)
    x = shipped.x_mm[::100].reshape(-1, 3)
    robots = replace(recording, annotations=shipped.labels, kinematics=replace(recording.kinematics, x_mm=shipped.x_mm))
    off = np.abs(recording.kinematics.x_mm - shipped.x_mm)  # of poses 5 um: the robot's noise moves no hinge
    assert np.nanmedian(off) < 5e-3 and (form == "pose only" or np.nanmax(off) < 1e-3)
    expected = rig_of(robots).project(x)
    np.testing.assert_allclose(rig_of(recording).project(x), expected, atol=0.02 if form == "pose only" else 0.01)
    if form == "side by side":  # the halves are not exchanged, and lie where they lay
        frame = recording.frames[3]
        assert np.abs(frame.left.astype(float) - shipped.frames[3, 0]).mean() < 4
        assert np.abs(frame.right.astype(float) - shipped.frames[3, 1]).mean() < 4


def test_a_topic_that_drops_out_leaves_its_landmark_blank(shipped, tmp_path):
    silent, x_mm = (shipped.robot_s > 3.0) & (shipped.robot_s < 6.0), shipped.x_mm.copy()
    x_mm[silent, 1] = np.nan
    folder, mapping = source_of(tmp_path, replace(shipped, x_mm=x_mm), foreign.side_by_side, foreign.robot_bag)
    found = logs.read_robot(folder, read_mapping(mapping), [])[1]
    blank = np.isnan(found).any(axis=2)
    assert blank[silent][2:-2, 1].all() and not blank[:, [0, 2]].any() and blank[~silent, 1].sum() <= 2


def test_times_of_arrival_hold_for_all_topics_of_a_bag(shipped, tmp_path):
    """The robot's clock, which stamps the messages, is 0.2 s ahead of the recorder's."""
    few = thinned(shipped, 20)
    folder, mapping = source_of(tmp_path, few, foreign.side_by_side, lambda *args: foreign.robot_bag(*args, ahead_s=0.2))
    mapping.write_text(mapping.read_text("utf-8").replace("/base:header.stamp", "/base:received"), "utf-8")
    time, x_mm, *_ = logs.read_robot(folder, read_mapping(mapping), [])
    np.testing.assert_allclose(logs.since(time, time[0]), few.robot_s - few.robot_s[0], atol=1e-8)
    np.testing.assert_allclose(x_mm, few.x_mm, atol=1e-3)


def test_an_import_is_repeatable_and_says_what_it_did(shipped, tmp_path):
    few = replace(thinned(shipped, 20), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, mapping = source_of(tmp_path, few, foreign.side_by_side, foreign.robot_csv)
    first = import_recording(folder, mapping, tmp_path / "one")
    assert import_recording(folder, mapping, tmp_path / "two") == first
    assert content(tmp_path / "one") == content(tmp_path / "two")
    assert json.loads((tmp_path / "one" / "import.json").read_text()) == first
    log = next(entry for entry in first["sources"] if entry["file"] == "log.csv")
    assert log["sha256"] == hashlib.sha256((folder / "log.csv").read_bytes()).hexdigest()
    assert "The mapping names no labels." in first["did"]
    doubts = Recording.open(tmp_path / "one").doubts
    assert "frame_times" not in {doubt.name for doubt in doubts}  # the video states its times, so a longer log is no wonder


def test_a_variable_frame_rate_keeps_its_times_and_lost_frames_leave_pairs(shipped, tmp_path):
    time_s = np.array([0.0, 0.04, 0.08, 0.2, 0.24, 0.28])
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    foreign.video(folder / "left.mkv", shipped.frames[:6, 0], time_s)
    kept = [0, 1, 3, 4, 5]
    foreign.video(folder / "right.mkv", shipped.frames[kept, 1], time_s[kept] + 0.003)
    two = '[video]\nlayout = "two"\nleft = "left.mkv"\nright = "right.mkv"\n'
    mapping.write_text(mapping.read_text("utf-8") + two, "utf-8")
    report = import_recording(folder, mapping, tmp_path / "eye")
    np.testing.assert_allclose(Recording.open(tmp_path / "eye").frames.time_s, time_s[kept], atol=1.1e-3)  # .mkv counts ms
    assert any("1 frame without a partner" in line for line in report["did"])
    assert any("frame rate varies" in line for line in report["did"])


def brightnesses(count: int) -> np.ndarray:
    """Frames (count, 48, 128, 3) of both views, each brighter than the one before by 8."""
    return np.repeat(8 * np.arange(count, dtype=np.uint8) + 10, 48 * 128 * 3).reshape(count, 48, 128, 3)


def shown_numbers(folder: Path) -> list[tuple[int, int]]:
    """For each frame of a recording of `brightnesses` at 25 fps: the number of the picture, and that of its time."""
    return [(round((frame.left.mean() - 10) / 8), round(25 * frame.time_s)) for frame in Recording.open(folder).frames]


def test_a_trimmed_video_gives_the_frames_that_it_shows(shipped, tmp_path):
    """`ffmpeg -ss 0.2 -i whole.mp4 -c copy stereo.mp4` copies frames from the key frame before, which nobody shall see."""
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    foreign.video(tmp_path / "whole.mp4", brightnesses(20), np.arange(20) / 25)
    foreign.cut(tmp_path / "whole.mp4", folder / "stereo.mp4", zero_s=Fraction(1, 5))
    video = '[video]\nlayout = "side_by_side"\nfile = "stereo.mp4"\n'
    mapping.write_text(mapping.read_text("utf-8") + video, "utf-8")
    import_recording(folder, mapping, tmp_path / "eye")
    assert shown_numbers(tmp_path / "eye") == [(5 + i, i) for i in range(15)]


def test_a_video_trimmed_at_its_end_is_whole(shipped, tmp_path):
    """Its edit list shows the first half, by duration in the header's units; the reader skips most of the rest."""
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    foreign.video(folder / "stereo.mp4", brightnesses(30), np.arange(30) / 25, gop=5)
    data = bytearray((folder / "stereo.mp4").read_bytes())
    at = data.index(b"elst") + 12
    data[at : at + 4] = (int.from_bytes(data[at : at + 4]) // 2).to_bytes(4)
    (folder / "stereo.mp4").write_bytes(data)
    mapping.write_text(mapping.read_text("utf-8") + '[video]\nlayout = "side_by_side"\nfile = "stereo.mp4"\n', "utf-8")
    import_recording(folder, mapping, tmp_path / "eye")
    assert 15 <= len(shown_numbers(tmp_path / "eye")) < 22


def test_an_avi_whose_frames_are_stored_in_another_order_is_read(shipped, tmp_path):
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    with av.open(str(folder / "stereo.avi"), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"bf": "2", "qp": "1"})
        stream.height, stream.width, stream.pix_fmt = 48, 128, "yuv420p"
        for image in brightnesses(24):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "bgr24")))
        container.mux(stream.encode())
    mapping.write_text(mapping.read_text("utf-8") + '[video]\nlayout = "side_by_side"\nfile = "stereo.avi"\n', "utf-8")
    import_recording(folder, mapping, tmp_path / "eye")
    assert shown_numbers(tmp_path / "eye") == [(i, i) for i in range(24)]


@pytest.mark.parametrize("name", ["stereo.ts", "stereo.mkv", "stereo.avi"])
def test_frames_keep_their_times_in_a_video_that_was_cut_between_key_frames(name, shipped, tmp_path):
    """The decoder drops what stands before the first key frame, number 10; an .avi gives no times to match."""
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    if name == "stereo.avi":
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*"XVID"), 25, (128, 48))
        for image in brightnesses(24):
            writer.write(image)
        writer.release()
    else:
        foreign.video(tmp_path / "whole.mp4", brightnesses(24), np.arange(24) / 25, gop=10)
        foreign.cut(tmp_path / "whole.mp4", folder / name, first=4)
    video = f'[video]\nlayout = "side_by_side"\nfile = "{name}"\n'
    mapping.write_text(mapping.read_text("utf-8") + video, "utf-8")
    import_recording(folder, mapping, tmp_path / "eye")
    shown = shown_numbers(tmp_path / "eye")
    late = 0 if name == "stereo.avi" else 10
    assert shown == [(i, i) for i in range(late, 24)]


def test_an_image_that_is_missing_leaves_its_partner_alone(shipped, tmp_path):
    """Numbers count frames: later pairs neither move in time nor get another's image."""
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    for k, name in enumerate(("left", "right")):
        for i in (i for i in range(8) if (k, i) != (1, 3) and i != 5):
            cv2.imwrite(str(folder / f"{name}_{10 * i}.png"), np.full((8, 8), 20 * i, np.uint8))
    video = '[video]\nlayout = "two"\nleft = "left_*.png"\nright = "right_*.png"\ntimes = "fps"\nfps = 25\n'
    mapping.write_text(mapping.read_text("utf-8") + video, "utf-8")
    report = import_recording(folder, mapping, tmp_path / "eye")
    frames = Recording.open(tmp_path / "eye").frames
    assert (25 * frames.time_s).round().tolist() == [0, 1, 2, 4, 6, 7]
    assert all(abs(image.mean() - 20 * 25 * f.time_s) < 3 for f in frames for image in (f.left, f.right))
    assert any("1 frame without a partner" in line for line in report["did"])


def test_both_cameras_with_the_same_files_are_refused(shipped, tmp_path):
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    for i in range(4):
        cv2.imwrite(str(folder / f"left_{i}.png"), np.full((8, 8), 20 * i, np.uint8))
    video = '[video]\nlayout = "two"\nleft = "left_*.png"\nright = "left_?.png"\ntimes = "fps"\nfps = 25\n'
    mapping.write_text(mapping.read_text("utf-8") + video, "utf-8")
    with pytest.raises(ValueError, match=r"left_0\.png: video\.left and video\.right both take it"):
        import_recording(folder, mapping, tmp_path / "eye")
    assert not (tmp_path / "eye").exists()


@pytest.mark.parametrize(("first", "numbers"), [(3, range(3, 10)), (101, range(7))])
def test_images_of_a_trigger_counter_pair_by_number_where_one_camera_starts_later(first, numbers, shipped, tmp_path):
    """Where no number is in both cameras, the first images are taken for one instant, and `did` says so."""
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    for name, start, shown in (("left", 0, range(10)), ("right", first, numbers)):
        for i, brightness in enumerate(shown):
            cv2.imwrite(str(folder / f"{name}_{start + i:04d}.png"), np.full((8, 8), 20 * brightness, np.uint8))
    video = '[video]\nlayout = "two"\nleft = "left_*.png"\nright = "right_*.png"\ntimes = "fps"\nfps = 25\n'
    mapping.write_text(mapping.read_text("utf-8") + video, "utf-8")
    report = import_recording(folder, mapping, tmp_path / "eye")
    frames = Recording.open(tmp_path / "eye").frames
    assert (25 * frames.time_s).round().tolist() == list(numbers)
    assert all(abs(image.mean() - 20 * 25 * f.time_s) < 3 for f in frames for image in (f.left, f.right))
    said = [line for line in report["did"] if "left 0 and right 101 are taken for one instant. If they are not, re" in line]
    assert len(said) == (first == 101)


def test_names_of_decimal_seconds_order_and_date_the_frames(shipped, tmp_path):
    """Dumps of ROS: read as one number, not by the digits after the point, which begin anew each second."""
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    time_s = [1700000000.7, 1700000000.9, 1700000001.1, 1700000001.3]
    for i, t in enumerate(time_s):
        for name in ("left", "right"):
            cv2.imwrite(str(folder / f"{name}_{t:.6f}.png"), np.full((8, 8), 60 * i, np.uint8))
    text = guess_mapping(folder)
    assert 'times = "names"' in text and 'name_unit = "s"' in text
    video = '[video]\nlayout = "two"\nleft = "left_*.png"\nright = "right_*.png"\ntimes = "names"\n'
    mapping.write_text(mapping.read_text("utf-8") + "offset_s = -1700000000\n" + video, "utf-8")
    with pytest.raises(ValueError, match=r"left_1700000000\.700000\.png: entries are 2e-10 s apart.*Check .*name_unit"):
        import_recording(folder, mapping, tmp_path / "eye")
    mapping.write_text(mapping.read_text("utf-8") + 'name_unit = "s"\n', "utf-8")
    import_recording(folder, mapping, tmp_path / "eye")
    frames = Recording.open(tmp_path / "eye").frames
    np.testing.assert_allclose(frames.time_s, [0.7, 0.9, 1.1, 1.3], atol=1e-6)
    assert all(abs(frame.left.mean() - 60 * i) < 3 for i, frame in enumerate(frames))
    (folder / "left_1700000001.300000.png").rename(folder / "left_1700000001.3.png")
    with pytest.raises(ValueError, match=r"not with as many digits .*Number the files 000000, .* times in a table"):
        import_recording(folder, mapping, tmp_path / "two")


@pytest.mark.parametrize("form", ["png", "one camera", "video"])
def test_twelve_grey_bits_in_sixteen_are_not_black(form, shipped, tmp_path):
    grey = (shipped.frames[:4].mean(axis=-1) * (4095 / 255)).astype(np.uint16)
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    if form != "video":
        for side, name in enumerate(("left", "right")):
            for i, image in enumerate(shipped.frames[:4, 1, ..., 0] if form == "one camera" and side else grey[:, side]):
                cv2.imwrite(str(folder / f"{name}_{i:04d}.png"), image)
        video = '[video]\nlayout = "two"\nleft = "left_*.png"\nright = "right_*.png"\ntimes = "fps"\nfps = 25\n'
    else:
        both = np.concatenate([grey[:, 0], grey[:, 1]], axis=2)
        foreign.video(folder / "grey.mkv", both, np.arange(4) / 25, "ffv1", "gray16le")
        video = '[video]\nlayout = "side_by_side"\nfile = "grey.mkv"\nformat = "png"\n'
    mapping.write_text(mapping.read_text("utf-8") + video, "utf-8")
    report = import_recording(folder, mapping, tmp_path / "eye")
    frame = Recording.open(tmp_path / "eye").frames[2]
    assert np.abs(frame.left.mean(axis=-1) - shipped.frames[2, 0].mean(axis=-1)).mean() < 2
    assert any("Frames of 12 bits" in line for line in report["did"])
    assert any("grey" in line for line in report["did"])


@pytest.mark.parametrize(("left", "right", "told"), [
    (4, 16, "Frames of 10 (left) and 12 (right) bits"),
    (3, 5, "Frames of 12 bits"),  # the left camera saw less light
])  # fmt: skip
def test_each_camera_may_have_its_own_depth(left, right, told, shipped, tmp_path):
    folder, mapping = source_of(tmp_path, thinned(shipped, 20), foreign.robot_csv)
    for name, factor, side in (("left", left, 0), ("right", right, 1)):
        for i, pair in enumerate(shipped.frames[:4]):
            grey = pair[side].mean(axis=-1) * factor
            grey[0, 0] = 256 * factor - 1
            cv2.imwrite(str(folder / f"{name}_{i:04d}.png"), grey.astype(np.uint16))
            (folder / f"._{name}_{i:04d}.png").write_bytes(b"\0\5\x16\7")  # macOS writes such files on foreign disks
    video = '[video]\nlayout = "two"\nleft = "*left_*.png"\nright = "*right_*.png"\ntimes = "fps"\nfps = 25\n'
    mapping.write_text(mapping.read_text("utf-8") + video, "utf-8")
    did = import_recording(folder, mapping, tmp_path / "eye")["did"]
    assert any(line.startswith(told) for line in did)
    frame, pair = Recording.open(tmp_path / "eye").frames[2], shipped.frames[2].mean(axis=(1, 2, 3))
    means = [frame.left.mean() / pair[0], frame.right.mean() / pair[1]]
    np.testing.assert_allclose(means[0] / means[1], 1 if left == 4 else left / right, rtol=0.05)


def test_other_landmarks_are_imported_and_calibrated(shipped, tmp_path):
    """A probe with two points: the import, its annotations and the calibration know no forceps."""
    two = lambda x: x[:, :2]  # noqa: E731
    labels = replace(shipped.labels, u_left=two(shipped.labels.u_left), u_right=two(shipped.labels.u_right),
                     visibility_left=None, visibility_right=None)  # fmt: skip
    folder, mapping = source_of(tmp_path, shipped, foreign.images, foreign.robot_csv)
    text = mapping.read_text("utf-8").replace("tip_1 =", "needle_tip =")
    text = text.replace(', tip_2 = ["tip_2_x", "tip_2_y", "tip_2_z"]', "")
    mapping.write_text('landmarks = ["base", "needle_tip"]\n' + text, "utf-8")
    import_recording(folder, mapping, tmp_path / "eye")
    recording = Recording.open(tmp_path / "eye")
    assert recording.skeleton == ("base", "needle_tip") and recording.landmarks_mm().shape == (34, 2, 3)
    rows = of_recording(recording, labels.u_left, labels.u_right)
    found = calibrate(rows, image_size_px=recording.image_size_px)
    assert found.inliers.sum() > 50 and found.reprojection_rms_px < 1


def test_the_guess_needs_little_change(shipped, tmp_path):
    folder, _ = source_of(tmp_path, shipped, foreign.side_by_side, foreign.robot_foreign_csv, foreign.labels_cvat)
    text = guess_mapping(folder)
    assert all("  # " in line for line in text.splitlines() if " = " in line)
    path = tmp_path / "guess.toml"
    path.write_text(text, "utf-8")
    told = read_mapping(path)
    assert (told.video.layout, told.robot.separator, told.robot.decimal) == ("side_by_side", ";", ",")
    assert (told.robot.time_unit, told.robot.length_unit, told.labels.kind) == ("ms", "m", "cvat")
    assert told.robot.landmarks["tip_1"] == ("Q x [m]", "Q y [m]", "Q z [m]")
    assert set(told.labels.names.values()) == set(foreign.NAMES.values())
    folder2 = tmp_path / "bag"
    folder2.mkdir()
    foreign.images(folder2, shipped), foreign.robot_bag(folder2, thinned(shipped, 80))
    path.write_text(guess_mapping(folder2), "utf-8")
    told = read_mapping(path)
    assert told.robot.landmarks["base"] == ("/base:point.x", "/base:point.y", "/base:point.z")
    assert (told.video.times, told.video.left) == ("names", "cam L/*.tiff")


def test_a_quaternion_of_any_name_is_no_point(shipped, tmp_path):
    folder, _ = source_of(tmp_path, shipped, foreign.images, foreign.robot_poses, lambda *_: "")
    log = folder / "pose.tsv"
    for axis in "wxyz":
        log.write_text(log.read_text().replace(f"q{axis}", f"pose.ori_{axis}", 1))
    pose = tomllib.loads(guess_mapping(folder))["robot"]["pose"]
    assert pose["rotation"] == [f"pose.ori_{axis}" for axis in "xyzw"] and pose["position"] == ["px", "py", "pz"]


def test_a_quaternion_of_zeros_is_a_gap(shipped, tmp_path):
    """So robots report a rotation that they do not know."""
    few = replace(thinned(shipped, 20), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, mapping = source_of(tmp_path, few, foreign.side_by_side, foreign.robot_poses, lambda *_: HINGE)
    log = folder / "pose.tsv"
    header, *rows = log.read_text().splitlines()
    cells = [row.split("\t") for row in rows]
    rows[:5] = ["\t".join([*row[:4], "0", "0", "0", "0", row[8]]) for row in cells[:5]]
    log.write_text("\n".join([header, *rows]))
    did = import_recording(folder, mapping, tmp_path / "eye")["did"]
    assert any("; 5 have gaps (an empty cell, or a quaternion of zeros)." in line for line in did)
    found = Recording.open(tmp_path / "eye").kinematics.x_mm
    assert np.isnan(found[:5]).all() and np.isfinite(found[5:]).all()


@pytest.mark.parametrize(("ends", "kind"), [
    (["q0", "q1", "q2", "q3"], "quaternion_wxyz"),
    ([f"rot[{i}][{j}]" for i in range(3) for j in range(3)], "matrix"),
    ([f"r{i}{j}" for i in "123" for j in "123"], "matrix"),
    (["j1", "j2", "j3", "j4"], ""),
])  # fmt: skip
def test_numbered_columns_are_a_rotation_where_their_values_are(ends, kind, shipped, tmp_path):
    """What the guess cannot know it leaves out, and says what to write."""
    few = replace(thinned(shipped, 80), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, path = source_of(tmp_path, few, foreign.side_by_side)
    turns = Rotation.from_matrix(np.array([pose.R for pose in foreign.posed(few)[0]]))
    values = turns.as_matrix().reshape(-1, 9) if kind == "matrix" else turns.as_quat(scalar_first=True)
    table = np.column_stack([few.robot_s, few.x_mm[:, 0], values if kind else values + 0.1])
    header = ",".join(["t", "px", "py", "pz", *ends])
    np.savetxt(folder / "log.csv", table, "%.7f", ",", header=header, comments="")
    text = guess_mapping(folder)
    pose = tomllib.loads(text)["robot"]["pose"]
    if not kind:
        assert "rotation" not in pose and "no rotation was found: add rotation = [its columns], rotation_kind" in text
        return
    assert (pose["rotation"], pose["rotation_kind"]) == (ends, kind)
    path.write_text(text.replace("jaw_mm = [0.0", "jaw_mm = [3.0"), "utf-8")
    np.testing.assert_allclose(logs.read_robot(folder, read_mapping(path), [])[2], turns.as_matrix(), atol=1e-5)


@pytest.mark.parametrize(("in_degrees", "doubted"), [(False, 2), (True, 0)])
def test_degrees_that_may_be_radians_are_doubted(in_degrees, doubted, shipped, tmp_path):
    few = replace(thinned(shipped, 20), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, mapping = source_of(tmp_path, few, foreign.side_by_side, foreign.robot_poses, lambda *_: HINGE)
    poses, opening, _ = foreign.posed(few)
    angles = np.column_stack([Rotation.from_matrix([pose.R for pose in poses]).as_euler("xyz"), opening])
    table = np.column_stack([few.robot_s, [pose.t for pose in poses], np.rad2deg(angles) if in_degrees else angles])
    np.savetxt(folder / "pose.tsv", table, "%.6f", "\t", header="s\tpx\tpy\tpz\tA\tB\tC\tjaw_deg", comments="")
    text = mapping.read_text("utf-8").replace('"qw", "qx", "qy", "qz"', '"A", "B", "C"').replace('"um"', '"mm"')
    text = text.replace("quaternion_wxyz", "euler_xyz_deg").replace('"stamp_ns"\ntime_unit = "ns"', '"s"')
    mapping.write_text(text.replace("offset_s = 1700000000", "offset_s = 0"), "utf-8")
    with warnings.catch_warnings(record=True, action="always") as caught:
        import_recording(folder, mapping, tmp_path / "eye")
    said = [str(warning.message) for warning in caught if "Are they radians?" in str(warning.message)]
    assert len(said) == doubted
    expected = ("A, B, C", '"rotation_vector_rad"'), ("jaw_deg", 'gripper_unit = "rad"')
    for text, (names, cure) in zip(said, expected, strict=False):
        assert re.search(rf"pose\.tsv: the angles in {names} are [\d.]+ degrees at most\. .*{cure}\.$", text)


@pytest.mark.parametrize(("in_degrees", "kind"), [(False, "rotation_vector_rad"), (True, "euler_xyz_deg")])
def test_rx_ry_rz_are_a_rotation_and_velocities_are_no_points(in_degrees, kind, shipped, tmp_path):
    few = replace(thinned(shipped, 80), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, _ = source_of(tmp_path, few, foreign.side_by_side)
    turns = Rotation.from_matrix([pose.R for pose in foreign.posed(few)[0]]).as_rotvec(degrees=in_degrees)
    table = np.column_stack([few.robot_s, few.x_mm[:, 0], turns, few.x_mm[:, 1:].reshape(-1, 6)])
    header = "t,TCP_x,TCP_y,TCP_z,TCP_rx,TCP_ry,TCP_rz,vx,vy,vz,Force_x,Force_y,Force_z"
    np.savetxt(folder / "log.csv", table, "%.6f", ",", header=header, comments="")
    text = guess_mapping(folder)
    columns = {"position": ["TCP_x", "TCP_y", "TCP_z"], "rotation": ["TCP_rx", "TCP_ry", "TCP_rz"]}
    assert tomllib.loads(text)["robot"]["pose"] == columns | {"rotation_kind": kind}
    assert re.search("pose = .* # CHECK: .*are rx, ry, rz a rotation vector, or Euler angles?", text)


@pytest.mark.parametrize(("names", "expected"), [
    (("left_{}", "right_{}"), {"layout": "two", "left": "img/left*.png", "right": "img/right*.png"}),
    (("{}_L", "{}_R"), {"layout": "two", "left": "img/*L.png", "right": "img/*R.png"}),
    (("cam_l_{}", "cam_r_{}"), {"layout": "two", "left": "img/*_l_*.png", "right": "img/*_r_*.png"}),
    (("{}",), {"layout": "side_by_side", "file": "img/*.png"}),
])  # fmt: skip
def test_the_guess_of_images_in_one_folder_matches_them_all(names, expected, shipped, tmp_path):
    few = replace(thinned(shipped, 80), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, path = source_of(tmp_path, few, foreign.robot_csv)
    (folder / "img").mkdir()
    for name in names:
        for i in range(6):
            image = np.full((20, 60 // len(names)), 9 * i, np.uint8)
            cv2.imwrite(str(folder / "img" / f"{name.format(f'{i:04d}')}.png"), image)
    text = guess_mapping(folder)
    video = tomllib.loads(text)["video"]
    assert {key: video[key] for key in expected} == expected
    assert ("CHECK: no names of left and right images were found" in text) == (len(names) == 1)
    path.write_text(text.replace('offset_s = "estimate"', "offset_s = 0"), "utf-8")
    import_recording(folder, path, tmp_path / "eye")
    assert len(Recording.open(tmp_path / "eye")) == 6


def test_times_of_day_and_a_row_of_units_are_read(shipped, tmp_path):
    few = replace(thinned(shipped, 5), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, path = source_of(tmp_path, few, foreign.side_by_side, foreign.robot_csv)
    header, *rows = (folder / "log.csv").read_text().splitlines()
    cells = [row.partition(",") for row in rows]
    rows = [f"9:{30 + int(float(t) // 60):02d}:{float(t) % 60:09.6f},{rest}" for t, _, rest in cells]
    (folder / "log.csv").write_text("\n".join([header, "hh:mm:ss" + ",mm" * 9, *rows]))
    text = guess_mapping(folder)
    path.write_text(text, "utf-8")
    told = read_mapping(path)
    assert (told.robot.time_unit, told.robot.length_unit) == ("hms", "mm")
    path.write_text(text.replace('offset_s = "estimate"', "offset_s = 34200"), "utf-8")
    did = import_recording(folder, path, tmp_path / "eye")["did"]
    recording = Recording.open(tmp_path / "eye")
    np.testing.assert_allclose(recording.landmarks_mm(), Kinematics(few.robot_s, few.x_mm).at(few.time_s), atol=1e-5)
    assert "Times of the robot count from 34199 s." in did and recording.offset_s == 1


def test_times_of_day_go_on_after_midnight(shipped, tmp_path):
    """The video passes midnight at its sixth frame, and the log with it."""
    few = replace(thinned(shipped, 5), frames=shipped.frames[:10], time_s=shipped.time_s[:10])
    folder, path = source_of(tmp_path, few, foreign.side_by_side, foreign.robot_csv)
    since_s = 86400 - few.time_s[5] + 0.01

    def of_day(t: float) -> str:
        t = (t + since_s) % 86400
        return f"{int(t // 3600):02d}:{int(t // 60 % 60):02d}:{t % 60:09.6f}"

    header, *rows = (folder / "log.csv").read_text().splitlines()
    cells = [row.partition(",") for row in rows]
    (folder / "log.csv").write_text("\n".join([header, *(f"{of_day(float(t))},{rest}" for t, _, rest in cells)]))
    (folder / "t.csv").write_text("\n".join(["stamp", *map(of_day, few.time_s)]))
    text = path.read_text("utf-8").replace("[robot]", '[robot]\ntime_unit = "hms"')
    table = '[video]\ntimes = "table"\ntable = { file = "t.csv", time = "stamp", time_unit = "hms" }\n'
    path.write_text(text.replace("[video]\n", table), "utf-8")
    import_recording(folder, path, tmp_path / "eye")
    recording = Recording.open(tmp_path / "eye")
    np.testing.assert_allclose(recording.frames.time_s, few.time_s + since_s, atol=1e-5)
    np.testing.assert_allclose(recording.landmarks_mm(), Kinematics(few.robot_s, few.x_mm).at(few.time_s), atol=1e-4)


@pytest.mark.parametrize(("late_s", "told"), [
    (5400.0, r"\+1\.5 hours between them\? Then offset_s = 5400"),
    (-3601.2, r"-1 hour between them\? Then offset_s = -3600"),
])  # fmt: skip
def test_a_local_time_zone_is_named(late_s, told, shipped, tmp_path):
    """Frames in Unix time, a log of dates without a zone."""
    few = replace(thinned(shipped, 20), frames=shipped.frames[:6], time_s=shipped.time_s[:6] + 1_700_000_000)
    late = replace(few, robot_s=few.robot_s - few.robot_s[0] + 1_700_000_000 + late_s)
    folder, mapping = source_of(tmp_path, late, foreign.images, foreign.robot_csv)
    with pytest.raises(ValueError, match=rf"so that they overlap.* Is a time zone of {told}\.$"):
        import_recording(folder, mapping, tmp_path / "eye")


def test_the_guess_reads_units_and_frame_times_where_no_name_states_them(shipped, tmp_path):
    few = replace(thinned(shipped, 10), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, path = source_of(tmp_path, few, foreign.side_by_side)
    numbers = np.column_stack([1e3 * few.robot_s, few.x_mm.reshape(len(few.x_mm), 9) / 1e3])
    rows = [";".join(f"{value:.7f}" for value in row) for row in numbers]
    header = "stamp;" + ";".join(f"{name}.{axis}" for name in ("joint", "a", "b") for axis in "XYZ")
    (folder / "log.csv").write_text("\n".join([header, *rows]).replace(".", ","), "utf-8")
    (folder / "frames.txt").write_text("ms\n" + "\n".join(f"{1e3 * t:.2f}" for t in few.time_s), "utf-8")
    path.write_text(guess_mapping(folder).replace(",X", ".X").replace(",Y", ".Y").replace(",Z", ".Z"), "utf-8")
    told = read_mapping(path)
    assert (told.robot.time_unit, told.robot.length_unit, told.robot.decimal) == ("ms", "m", ",")
    assert (told.video.times, told.video.table.file, told.video.table.time_unit) == ("table", "frames.txt", "ms")
    (folder / "log.csv").unlink()
    foreign.robot_poses(folder, few)
    path.write_text(guess_mapping(folder), "utf-8")
    with pytest.raises(ValueError, match=r"tool\.hinge.*cannot be 0: measure them"):
        read_mapping(path)
    foreign.labels_coco(folder, few)
    path.write_text(guess_mapping(folder), "utf-8")
    told = read_mapping(path)
    assert (told.tool.estimate, told.robot.offset_s) == (True, 0.0)


def test_the_guess_reads_integer_milliseconds_quotes_spaces_and_skips_notes(shipped, tmp_path):
    few = replace(thinned(shipped, 20), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, path = source_of(tmp_path, few, foreign.side_by_side)
    (folder / "notes.txt").write_bytes("Prüfung\n".encode("cp1252") * 9999)
    columns = [f"{name}_{axis}" for name in LANDMARKS for axis in "xyz"]
    values = np.column_stack([np.arange(len(few.robot_s)), few.x_mm.reshape(-1, 9)])
    np.savetxt(folder / "log.csv", values, ["%d"] + ["%.6f"] * 9, header=" ".join(["time", *columns]))
    np.savetxt(folder / "frames.txt", 1e3 * few.time_s, "%.2f", header="time [ms]")
    path.write_text(guess_mapping(folder), "utf-8")
    told = read_mapping(path)
    assert (told.robot.separator, told.robot.time_unit, told.video.table.file) == (" ", "ms", "frames.txt")
    time, x_mm, *_ = logs.read_robot(folder, told, [])
    assert float(time[7]) == 0.007
    np.testing.assert_allclose(x_mm, few.x_mm, atol=1e-6)
    quoted = ",".join(f'"{column}"' for column in ["time", *columns])
    np.savetxt(folder / "log.csv", values, "%.6f", ",", header=quoted, comments="")
    path.write_text(guess_mapping(folder), "utf-8")
    np.testing.assert_allclose(logs.read_robot(folder, read_mapping(path), [])[1], few.x_mm, atol=1e-6)
    (folder / "log.csv").write_bytes((folder / "log.csv").read_bytes() + b"\x81")  # now the log may be what cannot be read
    (folder / "notes.txt").unlink()
    with pytest.raises(ValueError, match=r"log\.csv, line \d+: the text is not UTF-8"):
        guess_mapping(folder)


@pytest.mark.parametrize("column", ["{name}_{axis}_cm", "{name} {axis} [cm]", "{name}.{axis}(CM)"])
def test_centimetres_are_guessed_from_the_columns_and_read(column, shipped, tmp_path):
    few = replace(thinned(shipped, 80), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    folder, path = source_of(tmp_path, few, foreign.side_by_side)
    header = ",".join(["time_s", *(column.format(name=name, axis=axis) for name in LANDMARKS for axis in "xyz")])
    values = np.column_stack([few.robot_s, few.x_mm.reshape(len(few.x_mm), 9) / 10])
    np.savetxt(folder / "log.csv", values, "%.7f", ",", header=header, comments="")
    path.write_text(guess_mapping(folder), "utf-8")
    told = read_mapping(path)
    assert told.robot.length_unit == "cm" and told.robot.landmarks["base"][0] == column.format(name="base", axis="x")
    np.testing.assert_allclose(logs.read_robot(folder, told, [])[1], few.x_mm, atol=1e-5)


@pytest.mark.parametrize("late_s", [0.8, 1_700_000_002])
def test_a_clock_beyond_its_search_is_found_elsewhere_in_the_log(late_s, shipped, tmp_path):
    """Also where one clock counts from a date.  The import says that it looked farther, and what a mapping would state."""
    late = replace(shipped, robot_s=shipped.robot_s + late_s)
    folder, mapping = source_of(tmp_path, late, foreign.images, foreign.robot_csv, foreign.labels_coco)
    mapping.write_text(mapping.read_text("utf-8").replace("[robot]\n", '[robot]\noffset_s = "estimate"\n'), "utf-8")
    did = import_recording(folder, mapping, tmp_path / "eye")["did"]
    zero, offset_s = int(late.robot_s[0]) if late_s > 1e6 else 0, Recording.open(tmp_path / "eye").offset_s
    assert abs(offset_s + zero - late_s) < 5e-4
    assert "The clock offset lies beyond search_s = 0.5: all with which log and video overlap were tried." in did
    told = f"offset_s is {offset_s:.4f} in recording.toml; in a mapping it would be {offset_s + zero:.4f}, since"
    assert any(line.startswith(told) for line in did) == (late_s > 1e6)


def test_a_clock_that_no_offset_explains_is_refused_with_what_was_searched(shipped, tmp_path):
    few = replace(shipped, labels=Annotations(*np.random.default_rng(0).uniform(5, 130, (2, *shipped.labels.u_left.shape))))
    folder, mapping = source_of(tmp_path, few, foreign.images, foreign.robot_csv, foreign.labels_coco)
    mapping.write_text(mapping.read_text("utf-8").replace("[robot]\n", '[robot]\noffset_s = "estimate"\n'), "utf-8")
    low, high = (shipped.robot_s[end] - shipped.time_s[-1 - end] for end in (0, -1))
    text = f"^robot.offset_s, searched from -0.500 to 0.500 s: .* No offset from {low:.3f} to {high:.3f} s fits. Give"
    with pytest.raises(ValueError, match=re.sub(r"([.+])(?!\*)", r"\\\1", text)):
        import_recording(folder, mapping, tmp_path / "eye")


def test_a_log_in_bursts_that_leaves_no_clock_to_estimate_is_said_to_come_in_bursts(shipped, tmp_path):
    number = np.arange(len(shipped.robot_s))
    buffered = replace(shipped, robot_s=shipped.robot_s[number // 20 * 20] + 6e-5 * (number % 20))
    folder, mapping = source_of(tmp_path, buffered, foreign.images, foreign.robot_csv, foreign.labels_coco)
    mapping.write_text(mapping.read_text("utf-8").replace("[robot]\n", '[robot]\noffset_s = "estimate"\n'), "utf-8")
    with pytest.raises(ValueError, match=r"The log's times come in bursts: usually 20 rows, then none for 0\.2 s\."):
        import_recording(folder, mapping, tmp_path / "eye")


@pytest.mark.parametrize(("late_s", "narrow_s", "refused"), [
    (60.0, 20, ""), (17.0, 5, ""), (-50_000.0, 49_000, r"do not overlap\..* or widen robot\.search_s to 49957"),
])  # fmt: skip
def test_a_wide_search_finds_a_clock_that_is_far_off(late_s, narrow_s, refused, shipped, tmp_path):
    """It is made if `search_s` is wide, and also if a narrow search fails but log and video overlap there."""
    late = replace(shipped, robot_s=shipped.robot_s + late_s)
    folder, mapping = source_of(tmp_path, late, foreign.images, foreign.robot_csv, foreign.labels_coco)
    text = mapping.read_text("utf-8")
    search = '[robot]\noffset_s = "estimate"\nsearch_s = {}\n'
    mapping.write_text(text.replace("[robot]\n", search.format(abs(late_s) + 5)), "utf-8")
    with warnings.catch_warnings(action="error"):  # the offset at which the search starts is of no interest
        clock = import_recording(folder, mapping, tmp_path / "eye")["clock"]
    assert abs(clock["offset_s"] - late_s) < 5e-4 and clock["sd_s"] < 5e-4
    assert np.isfinite(Recording.open(tmp_path / "eye").landmarks_mm()).all()
    mapping.write_text(text.replace("[robot]\n", search.format(narrow_s)), "utf-8")
    if not refused:
        assert import_recording(folder, mapping, tmp_path / "two")["clock"]["offset_s"] == pytest.approx(late_s, abs=5e-4)
        return
    with pytest.raises(ValueError, match=refused):
        import_recording(folder, mapping, tmp_path / "two")


def test_the_offsets_named_where_log_and_video_do_not_overlap_make_them_overlap(shipped, tmp_path):
    few = replace(thinned(shipped, 20), frames=shipped.frames[:6], time_s=shipped.time_s[:6])
    late = replace(few, robot_s=few.robot_s - few.robot_s[0] + 300.0)
    folder, mapping = source_of(tmp_path, late, foreign.side_by_side, foreign.robot_csv)
    text, low, high = mapping.read_text("utf-8"), 300.0, late.robot_s[-1] - few.time_s[-1]
    mapping.write_text(text.replace("[robot]\n", '[robot]\noffset_s = "estimate"\n'), "utf-8")
    cure = rf"set robot\.offset_s \(now 'estimate'\) in .* to a number from {low:.3f} to {high:.3f}, so that they overlap"
    with pytest.raises(ValueError, match=cure):
        import_recording(folder, mapping, tmp_path / "eye")
    for k, offset_s in enumerate((low + 0.001, high - 0.001)):
        mapping.write_text(text.replace("[robot]\n", f"[robot]\noffset_s = {offset_s:.3f}\n"), "utf-8")
        import_recording(folder, mapping, tmp_path / f"eye {k}")
        assert np.isfinite(Recording.open(tmp_path / f"eye {k}").landmarks_mm()).all()


def test_a_detector_that_knows_no_such_tool_leaves_the_clock_open(shipped, tmp_path, monkeypatch):
    few = replace(thinned(shipped, 5), frames=shipped.frames[:10], time_s=shipped.time_s[:10])
    folder, mapping = source_of(tmp_path, few, foreign.side_by_side, foreign.robot_csv)
    mapping.write_text(mapping.read_text("utf-8").replace("[robot]\n", '[robot]\noffset_s = "estimate"\n'), "utf-8")
    rng = np.random.default_rng(0)

    def lost(recording, detector, frames):
        u = rng.uniform(0, recording.image_size_px, (2, len(frames), 3, 2))
        return of_recording(recording, *u, frames=frames)

    monkeypatch.setattr("lib.importing.importer.detect", lost)
    with pytest.warns(UserWarning, match=r"not found; offset_s = 0 is a guess\. State robot\.offset_s in .*map\.toml"):
        report = import_recording(folder, mapping, tmp_path / "eye")
    assert report["clock"] is None and Recording.open(tmp_path / "eye").offset_s == 0
    assert any("offset of the clocks was not found" in line and "`check` and `adapt`" in line for line in report["did"])
    assert not any("fps" in line for line in report["did"])
    rate = mapping.read_text("utf-8").replace("[robot]", 'times = "fps"\nfps = 2\n[robot]', 1)
    mapping.write_text(rate, "utf-8")
    did = import_recording(folder, mapping, tmp_path / "fast")["did"]
    said = "The frames last 4.5 s with video.fps = 2, the robot's log {:.1f} s. If fps is a guess, correct it first."
    assert said.format(np.ptp(few.robot_s)) in did


def test_offsets_of_the_landmarks_are_no_part_of_the_clock(monkeypatch):
    """Whoever marks them takes other points of the tool; as it turns, that looks like another time."""
    recording, rng = Recording.open(paths.SHIPPED_RECORDING), np.random.default_rng(0)
    log, offset = recording.kinematics, np.array([[0.1, -0.15, 0.05], [-0.12, 0.1, 0.1], [0.15, 0.1, -0.08]])
    time_s = np.linspace(log.time_s[0] + 4, log.time_s[-1] - 4, 60)
    x = log.at(time_s)
    x += np.einsum("mij,kj->mki", np.nan_to_num(tool_axes(x)), offset)
    u = [u.reshape(60, 3, 2) + rng.normal(0, 1, (60, 3, 2)) for u in recording.truth.rig.project(x.reshape(-1, 3))]
    late = replace(log, time_s=log.time_s + 2.0)
    draft = replace(recording, kinematics=late, annotations=Annotations(*u), readout_s=0.0, frames=Frames(None, None, time_s))
    found = importer._clock(draft, 3.0, [])
    assert abs(found.offset_s - 2.0) < min(4e-4, 4 * found.sd_s)

    def undetermined(*data, **options):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(importer, "clock_error", undetermined)  # then the offset stays that of the shift alone
    assert abs(importer._clock(draft, 3.0, []).offset_s - 2.0) < 0.05


def test_a_few_labels_find_no_clock_in_the_log_of_another_run():
    """Among many offsets its motion fits eight labelled frames by chance; that of their own run does so far better."""
    recording = Recording.open(paths.SHIPPED_RECORDING)
    log, marks = recording.kinematics, recording.annotations
    known = np.isin(np.arange(34), np.linspace(0, 33, 8).astype(int))[:, None, None]
    labels = Annotations(*(np.where(known, u, np.nan) for u in (marks.u_left, marks.u_right)))
    for seed in (2, 4, 5):
        rng = np.random.default_rng(seed)
        place, turn = (gaussian_filter1d(rng.normal(size=(6000, 3)), 30, axis=0) for _ in range(2))
        place = log.x_mm[:, 0].mean(axis=0) + place * log.x_mm[:, 0].std(axis=0) / place.std(axis=0)
        R = Rotation.from_rotvec(0.2 * turn / turn.std(axis=0)).as_matrix()
        moving = place[:, None] + np.einsum("nij,kj->nki", R, log.x_mm[0] - log.x_mm[0, 0])
        other = replace(recording, kinematics=Kinematics(np.arange(6000) / 50, moving), annotations=labels)
        with pytest.raises(ValueError, match="offset_s"):
            importer._clock(other, 0.5, [])
    late = replace(recording, kinematics=replace(log, time_s=log.time_s + 17), annotations=labels)
    assert abs(importer._clock(late, 0.5, notes := []).offset_s - 17) < 1e-3 and len(notes) == 1


def test_jaws_are_estimated_from_poses_gripper_and_labels(shipped, tmp_path):
    """The labels carry 1 px of noise in the full frame, 10 um."""
    makers = foreign.images, foreign.robot_poses, lambda *_: "[tool]\nestimate = true\n", foreign.labels_coco
    folder, mapping = source_of(tmp_path, shipped, *makers)
    report = import_recording(folder, mapping, tmp_path / "eye")
    error = Recording.open(tmp_path / "eye").kinematics.x_mm - foreign.posed(shipped)[2]
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.max(list(report["tool"]["sd_mm"].values())) < 0.03


def test_a_tip_that_rests_in_one_point_gives_its_place(tmp_path, shipped):
    """`tool.pivot_s`: for some seconds of the log the tool turns about its tip."""
    rng = np.random.default_rng(0)
    tip, time = np.array([0.5, -0.2, 14.0]), np.arange(400) / 100
    turns = [RigidTransform.from_rotation_vector(v) for v in rng.uniform(-0.4, 0.4, (400, 3))]
    poses = [RigidTransform(p.R, [5, 5, 5] - p.R @ tip + 0.005 * rng.normal(size=3)) for p in turns]
    for i in range(200, 400):  # then it moves
        poses[i] = RigidTransform(turns[i].R, [i / 50, 0, 0])
    values = np.array([[t, *p.t, *p.R.ravel()] for t, p in zip(time, poses, strict=True)])
    folder, mapping = source_of(tmp_path, shipped)
    header = "t,x,y,z," + ",".join(f"r{k}" for k in range(9))
    np.savetxt(folder / "log.csv", values, "%.9f", ",", header=header, comments="")
    foreign.video(folder / "left.mp4", shipped.frames[:5, 0], np.arange(5) / 25)
    foreign.video(folder / "right.mp4", shipped.frames[:5, 1], np.arange(5) / 25)
    rotation = ", ".join(f'"r{k}"' for k in range(9))
    mapping.write_text(
        'name = "rest"\nlandmarks = ["tip", "shaft"]\n[video]\nlayout = "two"\nleft = "left.mp4"\nright = "right.mp4"\n'
        '[robot]\nfile = "log.csv"\ntime = "t"\nlength_unit = "mm"\n[robot.pose]\nposition = ["x", "y", "z"]\n'
        f'rotation = [{rotation}]\nrotation_kind = "matrix"\n'
        "[tool]\npivot_s = { tip = [0, 1.99] }\nlandmarks_mm = { shaft = [0, 0, 0] }\n"
    )
    report = import_recording(folder, mapping, tmp_path / "rest")
    np.testing.assert_allclose(report["tool"]["offset_mm"]["tip"], tip, atol=0.01)
    mapping.write_text(mapping.read_text().replace("[0, 1.99]", "[0, 0.01]"))
    with pytest.raises(ValueError, match="poses"):
        import_recording(folder, mapping, tmp_path / "short")


def test_a_wrong_rate_of_frames_is_named_where_the_clock_is_beyond_its_search(monkeypatch):
    def beyond(*data, **options):
        raise ValueError("offset_s: the search ends at its upper edge.")

    monkeypatch.setattr(importer, "estimate_time_offset", beyond)
    recording = Recording.open(paths.SHIPPED_RECORDING)
    fast_s = np.arange(len(recording)) / recording.fps
    fast = replace(recording, folder=Path("no frames.csv"), frames=Frames(None, None, fast_s))
    with pytest.raises(ValueError, match=r"at 25 fps last 1\.\d s, but the robot's log \d+\.\d s\..*frames\.csv"):
        importer._clock(fast, 0.5, [])
