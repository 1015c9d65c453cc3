"""Recordings: what is written is read, and what is wrong is refused with the file's name."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from lib import paths
from lib.cameras import NearAffineCamera
from lib.correspondences import of_recording
from lib.recordings import Annotations, Frames, Kinematics, Recording, RecordingWriter, Truth, read_image
from lib.recordings.annotations import write_coco
from lib.simulator.rig import reference_rig
from tests.importing import foreign

N, SIZE = 4, (64, 48)


def tool(m: int) -> np.ndarray:
    """Landmarks (m, 3, 3) mm of a tool of 4 mm that moves on a line."""
    shape = np.array([[0.0, 0, 0], [4.0, 0.5, 0], [4.0, -0.5, 0]])
    return shape + np.linspace(0, 1, m)[:, None, None] * np.array([1.0, 2.0, 3.0])


def frames(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (N, 2, SIZE[1], SIZE[0], 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A small, complete recording, read-only by agreement; `folder` gives a copy to spoil."""
    folder = tmp_path_factory.mktemp("recordings") / "whole"
    rng = np.random.default_rng(1)
    u = rng.uniform(0, 47, (2, N, 3, 2))
    u[0, 1, 2] = np.nan
    with RecordingWriter(
        folder,
        name="whole",
        fps=25.0,
        image_size_px=SIZE,
        readout_s=0.02,
        offset_s=0.1,
        suffix=".png",
        details={"seed": 1},
    ) as writer:
        for left, right in frames():
            writer.add(left, right)
        writer.kinematics(np.arange(40) * 0.01, tool(40))
        writer.annotations(*u)
        visibility = np.full((N, 3), 2)
        grid = np.arange(0.0, 64, 8), np.arange(0.0, 48, 8)
        surface = np.stack([*np.meshgrid(*grid), np.ones((6, 8))], axis=-1)
        in_glint = np.arange(2 * N * 3).reshape(2, N, 3) % 5 == 0
        truth = Truth(reference_rig(), tool(N), *u, visibility, visibility, writer.folder / "truth", *in_glint)
        truth.write(surface=(*grid, surface))
    return folder, u


@pytest.fixture
def folder(written, tmp_path):
    return shutil.copytree(written[0], tmp_path / "copy")


def edit(path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_what_is_written_is_read(written):
    folder, u = written
    recording = Recording.open(folder)
    assert (recording.name, recording.fps, recording.image_size_px) == ("whole", 25.0, SIZE)
    assert (recording.readout_s, recording.offset_s, recording.robot_accuracy_mm) == (0.02, 0.1, 0.010)
    assert recording.details == {"seed": 1}
    assert len(recording) == len(recording.frames) == N
    np.testing.assert_allclose(recording.frames.time_s, np.arange(N) / 25)
    for i, frame in enumerate(recording.frames):
        np.testing.assert_array_equal([frame.left, frame.right], frames()[i])  # PNG is lossless; the order is RGB
        assert frame.time_s == pytest.approx(i / 25)
    np.testing.assert_allclose(recording.kinematics.x_mm, tool(40), atol=1e-6)
    np.testing.assert_allclose(recording.annotations.u_left, u[0], atol=1e-3)
    assert recording.annotations.visibility_left[1].tolist() == [2, 2, 0]
    assert recording.truth is not None
    np.testing.assert_array_equal(recording.truth.rig.linear, reference_rig().linear)
    np.testing.assert_allclose(recording.truth.landmarks_mm, tool(N), atol=1e-7)
    np.testing.assert_allclose(recording.truth.u_right, u[1], atol=1e-5)
    in_glint = np.stack([recording.truth.in_glint_left, recording.truth.in_glint_right])
    np.testing.assert_array_equal(in_glint, np.arange(2 * N * 3).reshape(2, N, 3) % 5 == 0)
    np.testing.assert_allclose(recording.truth.surface([[3.0, 7.0]]), [[3, 7, 1]], atol=1e-6)
    assert np.isnan(recording.truth.surface([[63.0, 7.0]])).all()
    assert not (folder.parent / "whole.partial").exists()


def test_frames_are_kept_and_images_are_read_only(written):
    whole = Recording.open(written[0]).frames
    assert len(whole) == 4 and whole[1] is whole[1]
    assert whole[-2].time_s == pytest.approx(2 / 25)
    with pytest.raises(ValueError, match="read-only"):
        whole[1].left[0, 0] = 0
    with pytest.raises(IndexError, match="4 frames"):
        whole[4]


def test_cache_is_small(written):
    whole = Recording.open(written[0]).frames
    first = whole[0]
    for _ in range(3):
        list(whole)
    assert whole._read.cache_info().maxsize <= 4
    np.testing.assert_array_equal(whole[0].left, first.left)


def test_kinematics_interpolate_on_the_robot_clock(written):
    """Without pixels at the frame's time; with pixels when their rows were read."""
    recording = Recording.open(written[0])
    expected = recording.kinematics.at(recording.frames.time_s + 0.1)
    np.testing.assert_allclose(recording.landmarks_mm(), expected)
    u = np.full((N, 3, 2), (SIZE[1] - 1) / 2)
    u[:, 1, 1] = SIZE[1] - 1  # the last row is read half a readout after the middle row
    x_mm = of_recording(recording, u, u).grid("x_mm")
    speed_mm_s = np.array([1.0, 2.0, 3.0]) / 0.39
    np.testing.assert_allclose((x_mm - expected)[:, 1], np.broadcast_to(0.01 * speed_mm_s, (N, 3)), atol=1e-5)
    np.testing.assert_allclose((x_mm - expected)[:, [0, 2]], 0, atol=1e-12)


def test_dropped_samples_survive_the_round_trip(tmp_path):
    x = tool(5)
    x[3] = np.nan
    with RecordingWriter(tmp_path / "r", name="r", fps=10, image_size_px=SIZE, jpeg_quality=50) as writer:
        writer.add(*frames()[0], time_s=0.003)
        writer.kinematics([0.0, 0.1], x[:2])
        writer.kinematics(np.arange(2, 5) / 10, x[2:])
    recording = Recording.open(tmp_path / "r")
    np.testing.assert_allclose(recording.kinematics.x_mm, x, atol=1e-6)
    assert recording.frames.time_s == pytest.approx([0.003])  # uneven times go to frames.csv
    assert recording.annotations is None
    assert recording.truth is None


def spoil_jpeg(path):
    path.write_bytes(path.read_bytes()[:200])


def save(path, image, **options):
    Image.fromarray(image).save(path, **options)


def turned(path):
    """The frame as a JPEG that asks its readers to turn it by 180 degrees."""
    path.unlink()
    exif = Image.Exif()
    exif[0x0112] = 3
    save(path.with_suffix(".jpg"), np.zeros((SIZE[1], SIZE[0], 3), np.uint8), exif=exif)


def png_bomb(path):
    """A PNG of 100 bytes that claims 60000 x 60000 px."""
    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")]
    parts = [struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in chunks]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def fifo(path):
    path.unlink()
    os.mkfifo(path)


def recode(path, old: str, new: str, encoding: str):
    text = path.read_text()
    assert old in text
    path.write_bytes(text.replace(old, new, 1).encode(encoding))


SPOILERS = {
    "turned by EXIF": (
        lambda f: turned(f / "left/000002.png"),
        ValueError,
        r"000002\.jpg: its EXIF orientation is 3.* Export it upright",
    ),
    "png bomb": (lambda f: png_bomb(f / "right/000001.png"), ValueError, r"000001\.png: far larger.* Export it again"),
    "huge png": (
        lambda f: save(f / "right/000001.png", np.zeros((9500, 9500), np.uint8)),
        ValueError,
        r"000001\.png: 9500 x 9500 px, but",
    ),
    "pipe": (lambda f: fifo(f / "left/000001.png"), ValueError, r"000001\.png: not an ordinary file"),
    "pipe of kinematics": (lambda f: fifo(f / "kinematics.csv"), FileNotFoundError, r"kinematics\.csv"),
    "deep annotations": (
        lambda f: (f / "annotations.json").write_text("[" * 100_000 + "]" * 100_000),
        ValueError,
        r"annotations\.json: not COCO keypoints \(RecursionError.* Export",
    ),
    "deep header": (
        lambda f: (f / "recording.toml").write_text("a = " + "[" * 100_000 + "]" * 100_000),
        ValueError,
        r"recording\.toml: not valid TOML",
    ),
    "header in Latin-1": (
        lambda f: recode(f / "recording.toml", "whole", "Öl", "latin-1"),
        ValueError,
        r"recording\.toml: not valid TOML.* UTF-8",
    ),
    "UTF-16": (
        lambda f: recode(f / "kinematics.csv", "base", "base", "utf-16"),
        ValueError,
        r"kinematics\.csv, line 1: the text is not UTF-8\. Save",
    ),
    "Latin-1": (
        lambda f: recode(f / "kinematics.csv", "0.0300000", "dr\u00fcber", "latin-1"),
        ValueError,
        r"kinematics\.csv, line 5: the text is not UTF-8\. Save",
    ),
    "endless cell": (
        lambda f: recode(f / "kinematics.csv", "0.0300000", "3" * 200_000, "utf-8"),
        ValueError,
        r"kinematics\.csv, line 5: not CSV .* Export",
    ),
    "no header": (lambda f: (f / "recording.toml").unlink(), FileNotFoundError, r"recording\.toml"),
    "bad toml": (lambda f: edit(f / "recording.toml", "fps =", "fps"), ValueError, "not valid TOML"),
    "unknown key": (
        lambda f: edit(f / "recording.toml", "readout_s", "readout_ms"),
        ValueError,
        "unknown key readout_ms",
    ),
    "missing key": (lambda f: edit(f / "recording.toml", "fps = 25.0", ""), ValueError, "fps is missing"),
    "wrong type": (lambda f: edit(f / "recording.toml", "fps = 25.0", 'fps = "25"'), ValueError, "fps = '25'"),
    "zero fps": (lambda f: edit(f / "recording.toml", "fps = 25.0", "fps = 0"), ValueError, "must be positive"),
    "nan offset": (
        lambda f: edit(f / "recording.toml", "offset_s = 0.1", "offset_s = nan"),
        ValueError,
        "offset_s = nan",
    ),
    "readout in ms": (
        lambda f: edit(f / "recording.toml", "readout_s = 0.02", "readout_s = 20"),
        ValueError,
        "readout_s = 20",
    ),
    "accuracy in um": (
        lambda f: edit(f / "recording.toml", "robot_accuracy_mm = 0.01", "robot_accuracy_mm = 10"),
        ValueError,
        "not plausible in mm",
    ),
    "units": (lambda f: edit(f / "recording.toml", 'length = "mm"', 'length = "m"'), ValueError, "units.length = 'm'"),
    "skeleton": (lambda f: edit(f / "recording.toml", '"tip_1", "tip_2"', '"tip_2", "tip_1"'), ValueError, "skeleton"),
    "missing frame": (lambda f: (f / "left/000001.png").unlink(), ValueError, "frame 000001 is missing"),
    "mismatched counts": (lambda f: (f / "right/000003.png").unlink(), ValueError,
                          r"4 left and 3 right .* Add the frames of the right camera from 000003 on, or .* the left one\.$"),
    "mismatched counts, left": (lambda f: (f / "left/000003.png").unlink(), ValueError, "of the left camera from 000003 on"),
    "misnamed frame": (lambda f: (f / "left/000003.png").rename(f / "left/last.png"), ValueError, "named by number"),
    "not an image": (
        lambda f: (f / "left/000002.png").write_bytes(b"hello"),
        ValueError,
        r"000002\.png: the image is corrupt",
    ),
    "empty image": (
        lambda f: (f / "left/000002.png").write_bytes(b""),
        ValueError,
        r"000002\.png: the image is corrupt",
    ),
    "cut image": (lambda f: spoil_jpeg(f / "right/000002.png"), ValueError, r"000002\.png: the image is cut off"),
    "wrong size": (
        lambda f: cv2.imwrite(str(f / "right/000002.png"), np.zeros((10, 12, 3), np.uint8)),
        ValueError,
        r"000002\.png: 12 x 10 px, but .* \[64, 48\]",
    ),
    "no side": (lambda f: shutil.rmtree(f / "right"), FileNotFoundError, r"no right/ folder"),
    "empty recording": (
        lambda f: [p.unlink() for side in ("left", "right") for p in (f / side).iterdir()],
        ValueError,
        "recording is empty",
    ),
    "no kinematics": (lambda f: (f / "kinematics.csv").unlink(), FileNotFoundError, r"kinematics\.csv"),
    "nan kinematics": (
        lambda f: edit(f / "kinematics.csv", ",0.000000", ",nan"),
        ValueError,
        r"kinematics\.csv, line 2, column base_",
    ),
    "half a landmark": (
        lambda f: edit(f / "kinematics.csv", ",4.000000", ","),
        ValueError,
        "line 2: a landmark lacks some",
    ),
    "text kinematics": (
        lambda f: edit(f / "kinematics.csv", "0.0100000", "soon"),
        ValueError,
        "line 3, column time_s: 'soon'",
    ),
    "short row": (lambda f: edit(f / "kinematics.csv", "4.000000,", ""), ValueError, "line 2: 9 cells"),
    "time goes back": (lambda f: edit(f / "kinematics.csv", "0.0300000", "0.0100000"), ValueError, "line 5: time_s"),
    "column in metres": (
        lambda f: edit(f / "kinematics.csv", "base_x_mm", "base_x_m"),
        ValueError,
        "missing: base_x_mm; unknown: base_x_m",
    ),
    "semicolons": (
        lambda f: (f / "kinematics.csv").write_text((f / "kinematics.csv").read_text().replace(",", ";")),
        ValueError,
        r"kinematics\.csv, line 1: semicolons separate its cells\. "
        r"Save it with commas between cells and points in numbers\.$",
    ),
    "tabs": (
        lambda f: (f / "frames.csv").write_text("frame\ttime_s\n0\t0\n1\t0.04\n"),
        ValueError,
        r"frames\.csv, line 1: tabs separate its cells",
    ),
    "no kinematic rows": (
        lambda f: (f / "kinematics.csv").write_text((f / "kinematics.csv").read_text().splitlines()[0] + "\n"),
        ValueError,
        "table is empty",
    ),
    "clocks apart": (
        lambda f: edit(f / "recording.toml", "offset_s = 0.1", "offset_s = 99"),
        ValueError,
        "do not overlap",
    ),
    "frames.csv": (
        lambda f: (f / "frames.csv").write_text("frame,time_s\n0,0\n1,1\n"),
        ValueError,
        r"frames\.csv: expected one row",
    ),
    "frame times": (
        lambda f: (f / "frames.csv").write_text("frame,time_s\n0,0\n1,.1\n2,.1\n3,.3\n"),
        ValueError,
        r"frames\.csv, line 4",
    ),
    "bad coco": (lambda f: (f / "annotations.json").write_text("{}"), ValueError, "not COCO keypoints"),
    "a landmark's name is a list": (
        lambda f: edit(f / "annotations.json", '["base"', '[["base"]'),
        ValueError,
        r"annotations\.json: image left/000000\.\w+ has keypoints .*; \['base', 'tip_1', 'tip_2'\] are needed",
    ),
    "truth without rig": (lambda f: (f / "truth/rig.json").unlink(), FileNotFoundError, r"rig\.json"),
    "short truth": (
        lambda f: (f / "truth/landmarks.csv").write_text(
            "\n".join((f / "truth/landmarks.csv").read_text().splitlines()[:3])
        ),
        ValueError,
        "expected one row for each of the 4 frames",
    ),
    "some glints": (
        lambda f: edit(f / "truth/landmarks.csv", ",tip_2_right_in_glint", ""),
        ValueError,
        "missing: tip_2_right_in_glint",
    ),
    "half a glint": (
        lambda f: (f / "truth/landmarks.csv").write_text(
            re.sub(r"[01]$", "0.5", (f / "truth/landmarks.csv").read_text().strip())
        ),
        ValueError,
        "in_glint is 0 or 1",
    ),
}


@pytest.mark.parametrize("case", SPOILERS)
def test_bad_recordings_are_refused(folder, case):
    spoil, kind, text = SPOILERS[case]
    spoil(folder)
    with pytest.raises(kind, match=text):
        Recording.open(folder)


def test_a_zeroed_block_of_a_jpeg_is_noticed(tmp_path):
    """OpenCV and PIL decode it without complaint; a flat image with optimised tables may hold zeros rightly."""
    path, flat = tmp_path / "frame.jpg", tmp_path / "flat.jpg"
    save(path, np.random.default_rng(0).integers(0, 256, (256, 256, 3), dtype=np.uint8), quality=90)
    assert read_image(path).shape == (256, 256, 3)
    data = bytearray(path.read_bytes())
    data[20_000:21_024] = bytes(1024)
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"frame\.jpg: the image is corrupt; a block of zeros.* Export it again"):
        read_image(path)
    save(flat, np.zeros((2048, 2048, 3), np.uint8), optimize=True)
    assert bytes(512) in flat.read_bytes() and not read_image(flat).any()


def test_pixels_are_read_as_they_are_stored(tmp_path):
    image = np.zeros((48, 64, 3), np.uint8)
    image[:10] = 200
    exif = Image.Exif()
    exif[0x0112] = 3
    save(tmp_path / "turned.jpg", image, exif=exif, quality=95)
    np.testing.assert_allclose(read_image(tmp_path / "turned.jpg"), image, atol=30)


def test_near_affine_cameras_of_the_truth_survive(written, tmp_path):
    folder = shutil.copytree(written[0], tmp_path / "near")
    rig = reference_rig(inverse_distance_per_mm=1 / 150)
    rig.save(folder / "truth" / "rig.json")
    found = Recording.open(folder).truth.rig
    assert isinstance(found.left, NearAffineCamera) and not found.is_affine
    np.testing.assert_array_equal(found.project(tool(5)[:, 0]), rig.project(tool(5)[:, 0]))


@pytest.mark.parametrize("unit_mm", [1e3, 25.4])
def test_metres_and_inches_are_refused(tmp_path, unit_mm):
    writer = RecordingWriter(tmp_path / "r", name="r", fps=25, image_size_px=SIZE)
    with pytest.raises(ValueError, match="Metres, inches or micrometres"), writer:
        writer.add(*frames()[0])
        writer.kinematics([0.0, 1.0], tool(2) / unit_mm)
    assert list(tmp_path.iterdir()) == []  # whole or not at all


def test_a_log_of_the_base_alone_is_told_what_it_lacks(tmp_path):
    base = np.where((np.arange(3) == 0)[:, None], tool(2), np.nan)
    writer = RecordingWriter(tmp_path / "r", name="r", fps=25, image_size_px=SIZE)
    with pytest.raises(ValueError, match="no row holds base and one more; log base, tip_1, tip_2 in each row"), writer:
        writer.add(*frames()[0])
        writer.kinematics([0.0, 1.0], base)


def test_pixels_that_rot_after_opening_are_noticed(folder):
    recording = Recording.open(folder)
    path = folder / "left/000001.png"
    data = path.read_bytes()
    path.write_bytes(data[:50] + bytes(200))
    recording.frames[0]
    with pytest.raises(ValueError, match=r"000001\.png: the image is corrupt"):
        recording.frames[1]
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"000001\.png"):
        recording.frames[1]


def test_missing_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such recording"):
        Recording.open(tmp_path / "nowhere")


def coco(folder, change) -> None:
    path = folder / "annotations.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_coco_keypoints_in_any_order(folder):
    before = Recording.open(folder).annotations

    def reorder(content):
        content["categories"][0]["keypoints"] = ["tip_2", "shaft", "tip_1", "base"]
        for entry in content["annotations"]:
            base, tip_1, tip_2 = np.reshape(entry["keypoints"], (3, 3)).tolist()
            entry["keypoints"] = [*tip_2, 1, 1, 2, *tip_1, *base]

    coco(folder, reorder)
    np.testing.assert_array_equal(Recording.open(folder).annotations.u_left, before.u_left)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda c: c["images"][0].update(file_name="left/000099.jpg"), "not a frame of this recording"),
        (lambda c: c["images"][0].update(file_name="000000.jpg"), "not a frame of this recording"),
        (lambda c: c["annotations"].append(c["annotations"][0]), "annotated twice"),
        (lambda c: c["annotations"][0].update(image_id=99), "image 99"),
        (lambda c: c["annotations"][0].update(keypoints=[1, 2]), "x, y, visibility"),
        (lambda c: c["annotations"][0].update(keypoints=[1, 2, 3] * 3), "visibility is 0, 1 or 2"),
        (lambda c: c["annotations"][0].update(keypoints=[64, 2, 2] * 3), "outside the image"),
        (lambda c: c["categories"][0].update(keypoints=["a", "b", "c"]), "are needed"),
    ],
)
def test_bad_annotations_are_refused(folder, change, text):
    coco(folder, change)
    with pytest.raises(ValueError, match=text):
        Recording.open(folder)


def test_zeros_in_the_metadata_of_a_jpeg_are_no_damage(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.jpg", exif=b"Exif\0\0MM\0*\0\0\0\x08\0\0" + bytes(2000))
    assert read_image(tmp_path / "a.jpg").shape == (48, 64, 3)


def test_videos(tmp_path):
    """A pair of videos behaves like two folders, forwards, backwards and in jumps."""
    folder = tmp_path / "video"
    with RecordingWriter(folder, name="v", fps=25, image_size_px=SIZE) as writer:
        writer.add(*frames()[0])
        writer.kinematics([0.0, 2.0], tool(2))
    level = np.linspace(20, 235, 20)  # 20 frames, told apart by their grey level
    for side in ("left", "right"):
        shutil.rmtree(folder / side)
        video = cv2.VideoWriter(str(folder / f"{side}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25, SIZE)
        for value in level:
            video.write(np.full((SIZE[1], SIZE[0], 3), round(value), np.uint8))
        video.release()
    recording = Recording.open(folder)
    assert "video_times" not in {doubt.name for doubt in recording.doubts}
    read = recording.frames
    assert len(read) == 20
    for i in [0, 1, 2, 19, 5, 18, 3]:
        assert abs(read[i].left.mean() - level[i]) < 5.5  # the codec rounds; the next level is 11 away
    rng, bars = np.random.default_rng(0), 1 << np.arange(8)  # a frame shows its number, bit by bit
    for side in ("left", "right"):
        shown = np.uint8([255 * (i & bars > 0) for i in range(90)])[:, None, :, None].repeat(3, axis=3)
        images = np.stack([cv2.resize(image, SIZE, interpolation=cv2.INTER_NEAREST) for image in shown])
        foreign.video(folder / f"{side}.mp4", images, np.cumsum(rng.uniform(0.01, 0.3, 90)))  # at no constant rate
    read = Recording.open(folder).frames
    for i in [0, 80, 7, 41, 88, 89, 3]:
        bits = cv2.resize(read[i].right, (8, 1), interpolation=cv2.INTER_AREA)[0, :, 0] > 127
        assert bits @ bars == i
    (folder / "left").mkdir()
    with pytest.raises(ValueError, match="keep one"):
        Recording.open(folder)
    (folder / "left").rmdir()
    (folder / "left.mp4").write_bytes(b"no video")
    with pytest.raises(ValueError, match="cannot be opened"):
        Recording.open(folder)


def test_writer_refuses_bad_input(tmp_path, written):
    with pytest.raises(FileExistsError, match="overwrite=True"):
        RecordingWriter(written[0], name="x", fps=25, image_size_px=SIZE)
    with pytest.raises(ValueError, match="suffix"):
        RecordingWriter(tmp_path / "r", name="x", fps=25, image_size_px=SIZE, suffix=".bmp")
    writer = RecordingWriter(tmp_path / "r", name="x", fps=25, image_size_px=SIZE)
    with writer:
        with pytest.raises(ValueError, match="uint8 RGB"):
            writer.add(np.zeros((48, 64), np.uint8), np.zeros((48, 64), np.uint8))
        with pytest.raises(ValueError, match="x_mm"):
            writer.kinematics([0.0], np.zeros((2, 3, 3)))
        with pytest.raises(ValueError, match="u_left"):
            writer.annotations(np.zeros((3, 2)), np.zeros((3, 2)))
        writer.add(*frames()[0])
        writer.kinematics([0.0, 1.0], tool(2))
    with pytest.warns(UserWarning, match="held other recording.toml"):
        replace_recording(tmp_path / "r", name="second")
    assert Recording.open(tmp_path / "r").name == "second"


def replace_recording(folder: Path, seed: int = 0, **header) -> None:
    """Write a recording of one frame, also where there is one."""
    with RecordingWriter(folder, **({"name": "x"} | header), fps=25, image_size_px=SIZE, overwrite=True) as writer:
        writer.add(*frames(seed)[0])
        writer.kinematics([0.0, 1.0], tool(2))


def test_a_replaced_recording_loses_no_work(tmp_path):
    """Labels go on with the same frames; what else a person added or set is kept beside, and one line says so."""
    eye, marks = tmp_path / "eye", np.array([[[5.0, 6], [7, 8], [9, 10]]])
    replace_recording(eye)
    replace_recording(eye)
    assert [p.name for p in tmp_path.iterdir()] == ["eye"]
    write_coco(eye / "annotations.json", Annotations(marks, marks), SIZE, ".jpg")
    replace_recording(eye)
    assert Recording.open(eye).annotations.u_left[0].tolist() == marks[0].tolist()
    (eye / "raw").mkdir(), (eye / "raw" / "notes.txt").write_text("mine")
    with pytest.warns(UserWarning, match=r"held other annotations\.json, left, raw, recording\.toml, right, which") as told:
        replace_recording(eye, seed=1, offset_s=0.1)
    assert Recording.open(eye).annotations is None
    kept = Path(re.search(r"which (\S*) keeps", " ".join(str(one.message) for one in told))[1])
    assert (kept / "raw" / "notes.txt").read_text() == "mine" and (kept / "annotations.json").is_file()
    assert not (kept / "kinematics.csv").exists()


def test_the_writer_deletes_only_recordings(tmp_path):
    """Neither a folder of another kind, nor what lies where its own files will lie."""
    thesis, neighbour = tmp_path / "thesis", tmp_path / "eye.partial"
    for folder in (thesis, neighbour):
        folder.mkdir()
        (folder / "chapter.txt").write_text("years of work")
    with pytest.raises(FileExistsError, match="thesis: is not a recording and is left alone; choose another name"):
        RecordingWriter(thesis, name="x", fps=25, image_size_px=SIZE, overwrite=True)
    with RecordingWriter(tmp_path / "eye", name="x", fps=25, image_size_px=SIZE, overwrite=True) as writer:
        writer.add(*frames()[0])
        writer.kinematics([0.0, 1.0], tool(2))
    for folder in (thesis, neighbour):
        assert (folder / "chapter.txt").read_text() == "years of work"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["eye", "eye.partial", "thesis"]


def test_a_full_disk_leaves_the_old_recording(tmp_path, monkeypatch):
    def write(name: str) -> None:
        with RecordingWriter(tmp_path / "eye", name=name, fps=25, image_size_px=SIZE, overwrite=True) as writer:
            writer.add(*frames()[0])
            writer.kinematics([0.0, 1.0], tool(2))

    def full(path: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    write("first")
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        write("second")
    monkeypatch.undo()
    assert Recording.open(tmp_path / "eye").name == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["eye"]


def test_notes_of_any_name_and_value_are_read_back(tmp_path):
    details = {"surgeon's name": 'Dr. "B"', "depth": float("inf"), "seed": 3, "simulated": True}
    options = {"name": "r", "fps": 25, "image_size_px": SIZE, "details": details}
    with RecordingWriter(tmp_path / "r", **options) as writer:
        writer.add(*frames()[0])
        writer.kinematics([0.0, 1.0], tool(2))
    assert Recording.open(tmp_path / "r").details == details


def test_frames_count_without_leading_zeros(tmp_path):
    with RecordingWriter(tmp_path / "r", name="r", fps=25, image_size_px=SIZE, suffix=".png") as writer:
        for i in range(11):
            writer.add(*[np.full((SIZE[1], SIZE[0], 3), 10 * i, np.uint8)] * 2)
        writer.kinematics(np.arange(11) / 25, tool(11))
    for path in (tmp_path / "r").glob("*/*.png"):
        path.rename(path.with_stem(str(int(path.stem))))
    assert [frame.left[0, 0, 0] for frame in Recording.open(tmp_path / "r").frames] == [*range(0, 110, 10)]


def test_points_outside_the_image_are_written_as_not_labelled(tmp_path):
    u = np.full((1, 3, 2), 5.0)
    u[0, 0, 0] = 64.0
    with RecordingWriter(tmp_path / "r", name="r", fps=25, image_size_px=SIZE) as writer:
        writer.add(*frames()[0])
        writer.kinematics([0.0, 1.0], tool(2))
        writer.annotations(u, u)
    annotations = Recording.open(tmp_path / "r").annotations
    assert annotations.visibility_left.tolist() == [[0, 2, 2]]
    assert np.isnan(annotations.u_left[0, 0]).all()


def test_failure_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), RecordingWriter(tmp_path / "r", name="r", fps=25, image_size_px=SIZE) as writer:
        writer.add(*frames()[0])
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("text", "frames"), [
    (":", range(34)), ("0:17", range(17)), ("17:", range(17, 34)), ("-4:", range(30, 34)), ("30:99", range(30, 34)),
    ("17", None), ("9:9", None), ("34:40", None), ("0:17:2", None), ("a:b", None), ("", None),
])  # fmt: skip
def test_frames_are_named_as_slices_are(text, frames):
    recording = Recording.open(paths.SHIPPED_RECORDING)
    if frames is not None:
        assert recording.frames_of(text) == frames
        return
    why = "it names none of frames 0 to 33" if text in ("9:9", "34:40") else "two numbers and a colon are needed"
    with pytest.raises(ValueError, match=rf"^--frames {text}: {why}; give A:B, .* such as 0:17\.$"):
        recording.frames_of(text)


# --- what is suspicious is told at opening


@pytest.mark.parametrize(("frames", "times", "jump", "name"), [
    (34, np.arange(0, 43, 0.1), 0.0, "frame_times"),
    (100, np.arange(0, 2, 0.01), 0.0, "little_overlap"),
    (40, np.arange(-1, 4, 1.0), 0.0, "slow_log"),
    (40, np.arange(-1, 4, 0.2), 0.0, "slow_log"),
    (40, np.arange(-1, 4, 0.1) + 0.04 * np.sin(7.0 * np.arange(50)), 0.0, None),
    (40, np.arange(-0.1, 2, 0.01), 500.0, "jump"),
    (40, np.arange(-0.1, 2, 0.01), 0.0, None),
])  # fmt: skip
def test_doubts(frames, times, jump, name, tmp_path):
    log = Kinematics(times, np.repeat(tool(1), len(times), axis=0))
    log.x_mm[2] += jump
    at = Frames(None, None, np.arange(frames) / 25)
    shipped = Recording.open(paths.SHIPPED_RECORDING)
    recording = replace(shipped, folder=tmp_path, frames=at, fps=25.0, offset_s=0.0, kinematics=log)
    assert [doubt.name for doubt in recording.doubts] == ([name] if name else [])
    assert bool(recording.mistimed) == (name not in (None, "jump"))
    (tmp_path / "frames.csv").touch()  # the recording states the times of its frames, as an import does that knows them
    assert [doubt.name for doubt in replace(recording).doubts] == ([name] if name not in (None, "frame_times") else [])


def test_a_log_in_centimetres_is_in_doubt():
    recording = Recording.open(paths.SHIPPED_RECORDING)
    log = Kinematics(recording.kinematics.time_s, 0.1 * recording.kinematics.x_mm)
    recording = replace(recording, kinematics=log)
    assert [doubt.name for doubt in recording.doubts] == ["units"] and "cm" in recording.doubts[0].cure
    assert not recording.mistimed


@pytest.mark.parametrize("named", [False, True])
def test_cells_that_are_left_blank_where_the_robot_was_silent_are_no_doubt(named):
    """The cure of a log that stood still for a while; samples that are missing are doubted."""
    times = np.arange(-0.1, 2, 0.01)
    silent = (times > 0.4) & (times < 1.2)
    log = Kinematics(times, np.where(silent[:, None, None], np.nan, tool(1)))
    log = Kinematics(times[~silent], log.x_mm[~silent]) if named else log
    at = Frames(None, None, np.arange(40) / 25)
    recording = replace(Recording.open(paths.SHIPPED_RECORDING), frames=at, fps=25.0, offset_s=0.0, kinematics=log)
    assert [doubt.name for doubt in recording.doubts] == ["little_overlap"] * named


@pytest.mark.parametrize(
    ("held", "grid_mm", "trembles_mm", "named"),
    [
        (5, 0.0, 0.0, True), (1, 0.0, 0.0, False), (1, 0.02, 0.0, False), (1, 0.5, 0.0, True), (5, 0.0, 0.005, True),
        (1, 0.0, 0.0005, False),
    ],
)  # fmt: skip
def test_a_log_that_repeats_its_positions_is_in_doubt(held, grid_mm, trembles_mm, named):
    """A slow robot and a fast logger, or a coarse grid; a fine one does no harm.  Rests count little, also noisy ones."""
    recording = Recording.open(paths.SHIPPED_RECORDING)
    log = recording.kinematics
    x = log.x_mm.copy()
    if trembles_mm:
        rest = x[: 4 * len(x) // 5]
        rest[:] = x[0] + np.round(np.random.default_rng(0).normal(0, trembles_mm, rest.shape), 3)  # in steps of 1 um
        rest[:] = rest[np.arange(len(rest)) // 3 * 3]
    x = x[np.arange(len(x)) // held * held]
    x = np.round(x / grid_mm) * grid_mm if grid_mm else x
    x[100:400] = x[100]
    recording = replace(recording, kinematics=Kinematics(log.time_s, x))
    assert [doubt.name for doubt in recording.doubts] == ["repeated_samples"] * named
    if held > 1:
        assert "a row every 0.01 s, but usually a new position only every 0.05 s" in recording.mistimed
        assert "Keep the first of each run of equal rows" in recording.mistimed


@pytest.mark.parametrize(("burst_s", "pause_s", "named"), [(0.001, 0.2, True), (0.1, 0.2, False), (0.001, 5.0, False)])
def test_a_log_whose_times_come_in_bursts_is_in_doubt(burst_s, pause_s, named, tmp_path):
    """Rows that a buffer delivers together; a log with breaks, or that states a part of the motion, is as it should be."""
    starts = np.arange(-2.0 * pause_s, 12 * pause_s + 4, pause_s)
    times = (starts[:, None] + np.linspace(0, burst_s, 20)).ravel()
    log = Kinematics(times, np.repeat(tool(1), len(times), axis=0))
    at = Frames(None, None, np.arange(int(250 * pause_s)) / 25)
    (tmp_path / "frames.csv").touch()
    shipped = Recording.open(paths.SHIPPED_RECORDING)
    recording = replace(shipped, folder=tmp_path, frames=at, fps=25.0, offset_s=0.0, kinematics=log)
    assert [d.name for d in recording.doubts if d.name != "little_overlap"] == ["bursts"] * named
    assert not named or "bursts: usually 20 rows, then none for 0.2 s. A buffer" in recording.mistimed


@pytest.mark.parametrize("times", [np.arange(30) / 50, np.cumsum(np.where(np.arange(30) % 10 == 9, 0.4, 0.04))])
def test_a_video_whose_times_are_not_those_of_fps_is_in_doubt(times, tmp_path):
    """Without frames.csv the times in the videos are not read, so that another or a variable rate would be missed."""
    folder = tmp_path / "video"
    with RecordingWriter(folder, name="v", fps=25, image_size_px=SIZE) as writer:
        writer.add(*frames()[0])
        writer.kinematics(np.arange(-1, 3, 0.01), tool(400))
    for side in ("left", "right"):
        shutil.rmtree(folder / side)
        foreign.video(folder / f"{side}.mp4", np.zeros((30, SIZE[1], SIZE[0], 3), np.uint8), times)
    late_s = np.abs(times - times[0] - np.arange(30) / 25).max()
    with pytest.warns(UserWarning, match=rf"The videos' times are {late_s:.2f} s off those of fps = 25\. Set fps to"):
        recording = Recording.open(folder)
    assert "video_times" in {doubt.name for doubt in recording.doubts} and "frames.csv" in recording.mistimed
    table = "".join(f"{i},{time:.6f}\n" for i, time in enumerate(times))
    (folder / "frames.csv").write_text("frame,time_s\n" + table)
    assert "video_times" not in {doubt.name for doubt in Recording.open(folder).doubts}


def test_a_tiff_of_several_pages_is_refused(tmp_path):
    one, several = tmp_path / "one.tif", tmp_path / "several.TIFF"
    pages = np.zeros((3, 8, 8, 3), np.uint16)
    Image.fromarray(pages[0].astype(np.uint8)).save(one)
    assert read_image(one).shape == (8, 8, 3)
    several.write_bytes(cv2.imencodemulti(".tiff", list(pages))[1].tobytes())
    with pytest.raises(ValueError, match=r"several\.TIFF: a TIFF of several pages, .* Export single files\."):
        read_image(several)


def test_nothing_is_interpolated_in_a_gap():
    log = Kinematics(np.array([0.0, 0.01, 0.02, 3600.0, 3600.01]), np.zeros((5, 3, 3)))
    assert np.isfinite(log.at([0.015, 0.02, 1800.0, 3600.0, 3600.005])[:, 0, 0]).tolist() == [True, True, False, True, True]
    slow = Kinematics(np.array([0.0, 0.1, 0.2, 0.6, 0.7, 1.3, 1.4]), np.zeros((7, 3, 3)))  # three samples lost, then five
    assert np.isfinite(slow.at([0.15, 0.4, 1.0])[:, 0, 0]).tolist() == [True, True, False]


def test_a_move_that_fails_says_why_and_leaves_nothing(tmp_path, monkeypatch):
    writer = RecordingWriter(tmp_path / "r", name="r", fps=25, image_size_px=SIZE)
    with pytest.raises(OSError, match="No space left"), writer:
        for left, right in frames():
            writer.add(left, right)
        writer.kinematics(np.linspace(-1, 1, 50), tool(50))
        monkeypatch.setattr("lib.recordings.recording.os.replace", full_disk)
    assert not list(tmp_path.iterdir())


def full_disk(*_):
    raise OSError(errno.ENOSPC, "No space left on device")
