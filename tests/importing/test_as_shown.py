"""What files state about themselves, or leave out: turned images, lost frames, sentinels, encodings, headers."""

import json
import struct
import tomllib
import warnings
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from lib.correspondences import LANDMARKS
from lib.importing import guess_mapping, import_recording, logs, read_mapping, video
from lib.recordings import Recording
from tests.importing import foreign
from tests.importing.test_import import HINGE, source_of, thinned

TWO = '[video]\nlayout = "two"\nleft = "left.mp4"\nright = "right.mp4"\n'


@pytest.fixture(scope="module")
def few():
    shipped = foreign.shipped()
    return replace(thinned(shipped, 10), frames=shipped.frames[:6], time_s=shipped.time_s[:6])


def quietly(folder: Path, mapping: Path, out: Path) -> tuple[list[str], Recording]:
    """What an import says, and the recording; a short one causes warnings of its own."""
    with warnings.catch_warnings(action="ignore"):
        return import_recording(folder, mapping, out, overwrite=True)["did"], Recording.open(out)


def log_of(folder: Path, few, change) -> Path:
    """A changed log in an own folder, and its mapping."""
    mapping = folder / "map.toml"
    mapping.write_text('name = "eye"\n' + TWO + foreign.robot_csv(folder, few), "utf-8")
    log = folder / "log.csv"
    log.write_bytes(change(log.read_text()))
    return mapping


# --- images


@pytest.mark.parametrize("degrees", [90, 180])
def test_a_video_is_imported_as_players_show_it(degrees, few, tmp_path):
    """The display matrix of an .mp4 turns each image clockwise; a key of the mapping turns it further."""
    folder, mapping = source_of(tmp_path, few, foreign.robot_csv)
    matrix = {90: (0, 65536, 0, -65536, 0, 0), 180: (-65536, 0, 0, 0, -65536, 0)}[degrees]
    for side, name in enumerate(("left.mp4", "right.mp4")):
        foreign.video(folder / name, few.frames[:, side], few.time_s)
        data = bytearray((folder / name).read_bytes())
        at = data.index(b"tkhd") + 44
        data[at : at + 24] = struct.pack(">6i", *matrix)
        (folder / name).write_bytes(data)
    given = mapping.read_text("utf-8")
    for more in (0, 90):
        mapping.write_text(given + TWO + f"rotate_left = {more}\nrotate_right = {more}\n", "utf-8")
        did, recording = quietly(folder, mapping, tmp_path / "eye")
        expected = np.rot90(few.frames[3, 1], -(degrees + more) // 90)
        assert np.abs(recording.frames[3].right.astype(float) - expected).mean() < 4
        turned = "90 degrees clockwise" if degrees == 90 else "180 degrees"
        assert f"left.mp4 states that it is shown turned by {turned}; its camera's images were turned so." in did


def test_a_video_that_is_shown_mirrored_is_refused_and_a_turned_pair_is_guessed_as_shown(few, tmp_path):
    foreign.side_by_side(tmp_path, few)
    foreign.robot_csv(tmp_path, few)
    data = bytearray((tmp_path / "stereo.mp4").read_bytes())
    at = data.index(b"tkhd") + 44
    data[at : at + 24] = struct.pack(">6i", -65536, 0, 0, 0, 65536, 0)
    (tmp_path / "stereo.mp4").write_bytes(data)
    with pytest.raises(ValueError, match="stereo.mp4: states that it is shown mirrored"):
        video._Film(tmp_path / "stereo.mp4")
    data[at : at + 24] = struct.pack(">6i", 0, 65536, 0, -65536, 0, 0)
    (tmp_path / "stereo.mp4").write_bytes(data)
    assert 'layout = "top_bottom"' in guess_mapping(tmp_path)


@pytest.mark.parametrize(("layout", "axis", "aspect"), [("side_by_side", 1, 2.0), ("top_bottom", 0, 0.5)])
def test_views_that_are_squeezed_into_one_frame_are_guessed_and_stretched(layout, axis, aspect, few, tmp_path):
    folder, mapping = source_of(tmp_path, few, foreign.robot_csv)
    height, width = few.frames.shape[2:4]
    size = (width // 2, height) if axis == 1 else (width, height // 2)
    packed = [
        np.concatenate([cv2.resize(view, size, interpolation=cv2.INTER_AREA) for view in pair], axis=axis)
        for pair in few.frames
    ]
    foreign.video(folder / "stereo.mp4", np.array(packed), few.time_s)
    guess = guess_mapping(folder)
    assert f'layout = "{layout}"' in guess and f"pixel_aspect = {aspect}" in guess
    given = f'[video]\nlayout = "{layout}"\nfile = "stereo.mp4"\npixel_aspect = {aspect}\n'
    mapping.write_text(mapping.read_text("utf-8") + given, "utf-8")
    did, recording = quietly(folder, mapping, tmp_path / "eye")
    for side, image in enumerate((recording.frames[3].left, recording.frames[3].right)):
        assert image.shape == few.frames[3, side].shape
        off = np.abs(image.astype(float) - few.frames[3, side]).mean()
        assert off < 6 and off < 0.5 * np.abs(np.roll(image, 4, axis=1).astype(float) - few.frames[3, side]).mean()
    assert any("square" in line for line in did)
    with pytest.raises(ValueError, match="labels .* are not read"):
        mapping.write_text(f"{mapping.read_text('utf-8')}[labels]\nkind = 'coco'\nfile = 'labels.json'\n", "utf-8")
        read_mapping(mapping)


@pytest.mark.parametrize("layout", ["two", "side_by_side"])
def test_an_interlaced_video_is_told_guessed_and_filled_in(layout, few, tmp_path):
    """Its odd rows show everything elsewhere."""
    folder, mapping = source_of(tmp_path, few, foreign.robot_csv)
    shown = few.frames[:, :, : few.frames.shape[2] // 4 * 4]  # interlaced H.264 needs it
    frames = shown.copy()
    frames[:, :, 1::2] = np.roll(shown, 40, axis=3)[:, :, 1::2]
    if layout == "two":
        for side, name in enumerate(("left.mp4", "right.mp4")):
            foreign.video(folder / name, frames[:, side], few.time_s, interlaced=True)
        text = TWO
    else:
        beside = np.concatenate([frames[:, 0], frames[:, 1]], axis=2)
        foreign.video(folder / "stereo.mp4", beside, few.time_s, interlaced=True)
        assert "deinterlace = true" in guess_mapping(folder)
        text = '[video]\nlayout = "side_by_side"\nfile = "stereo.mp4"\n'
    given = mapping.read_text("utf-8")
    off = []
    for more in ("", "deinterlace = true\n"):
        mapping.write_text(given + text + more, "utf-8")
        did, recording = quietly(folder, mapping, tmp_path / "eye")
        off.append(np.abs(recording.frames[3].left.astype(float) - shown[3, 0]).mean(axis=(1, 2)))
        assert any("is interlaced: " in line for line in did) == (not more)
        assert any("even rows were kept" in line for line in did) == bool(more)
    assert off[1][::2].mean() < 1.2 * off[0][::2].mean() and off[1][1::2].mean() < 0.6 * off[0][1::2].mean()


def test_pixels_that_a_video_states_as_not_square_are_told(few, tmp_path):
    folder, mapping = source_of(tmp_path, few, foreign.robot_csv)
    for side, name in enumerate(("left.mp4", "right.mp4")):
        foreign.video(folder / name, few.frames[:, side], few.time_s, aspect=Fraction(4, 3))
    mapping.write_text(mapping.read_text("utf-8") + TWO, "utf-8")
    did, recording = quietly(folder, mapping, tmp_path / "eye")
    assert any("left.mp4 states pixels 1.3333 times as wide as high" in line for line in did)
    assert recording.frames[0].left.shape == few.frames[0, 0].shape


@pytest.mark.parametrize(("orientation", "shown"), [
    (3, lambda x: x[::-1, ::-1]), (4, lambda x: x[::-1]), (5, lambda x: x.swapaxes(0, 1)), (6, lambda x: np.rot90(x, -1)),
])  # fmt: skip
def test_images_are_imported_as_their_exif_orientation_shows_them(orientation, shown, few, tmp_path):
    folder, mapping = source_of(tmp_path, few, foreign.robot_csv)
    exif = Image.Exif()
    exif[0x0112] = orientation
    for side, name in enumerate(("left", "right")):
        for i in range(6):
            Image.fromarray(few.frames[i, side]).save(folder / f"{name}_{i}.png", exif=exif)
    video = '[video]\nlayout = "two"\nleft = "left_*.png"\nright = "right_*.png"\ntimes = "fps"\nfps = 25\nformat = "png"\n'
    mapping.write_text(mapping.read_text("utf-8") + video, "utf-8")
    did, recording = quietly(folder, mapping, tmp_path / "eye")
    np.testing.assert_array_equal(recording.frames[2].left, shown(few.frames[2, 0]))
    assert f"left_0.png has the EXIF orientation {orientation}; its camera's images were turned so." in did


@pytest.mark.parametrize(("times", "kept", "warned"), [
    ("container", 5, True), ("fps", 5, True), ("container", 6, False),
])  # fmt: skip
def test_a_camera_that_may_have_lost_frames_is_doubted(times, kept, warned, few, tmp_path):
    """Both videos count from 0 at one rate, so nothing tells whether the shorter one ended early."""
    folder, mapping = source_of(tmp_path, few, foreign.robot_csv)
    foreign.video(folder / "left.mp4", few.frames[:, 0], np.arange(6) / 25)
    foreign.video(folder / "right.mp4", few.frames[:kept, 1], np.arange(kept) / 25)
    mapping.write_text(mapping.read_text("utf-8") + TWO + f'times = "{times}"\nfps = 25\n', "utf-8")
    with warnings.catch_warnings(record=True, action="always") as caught:
        import_recording(folder, mapping, tmp_path / "eye")
    said = [str(warning.message) for warning in caught if "lost frames" in str(warning.message)]
    assert len(said) == warned
    assert all("6 left and 5 right frames, both at a steady rate" in text and "lib check`" in text for text in said)


def test_a_video_without_times_is_refused_with_what_to_set(few, tmp_path):
    """The table of an .mp4 states that each frame lasts for 0 units."""
    folder, mapping = source_of(tmp_path, replace(few, time_s=np.arange(6) / 25), foreign.side_by_side, foreign.robot_csv)
    data = bytearray((folder / "stereo.mp4").read_bytes())
    entries = data.index(b"stts") + 12
    for at in range(entries, entries + 8 * int.from_bytes(data[entries - 4 : entries]), 8):
        data[at + 4 : at + 8] = bytes(4)
    (folder / "stereo.mp4").write_bytes(data)
    what = r'stereo\.mp4: \d of its 6 frames have the time of another one\. Set video\.times = "fps" with their rate'
    with pytest.raises(ValueError, match=what):
        import_recording(folder, mapping, tmp_path / "eye")


# --- logs


@pytest.mark.parametrize("value", ["-9999", "0"])
def test_a_number_that_stands_for_no_report_leaves_a_gap(value, few, tmp_path):
    few = replace(few, x_mm=few.x_mm + 100)

    def change(text: str) -> bytes:
        header, *rows = (row.split(",") for row in text.splitlines())
        for i in (7, 30, 31):
            rows[i][4:7] = [value] * 3
        rows[50][1] = value  # one coordinate alone is a position
        return "\n".join(map(",".join, [header, *rows])).encode()

    x_mm = logs.read_robot(tmp_path, read_mapping(log_of(tmp_path, few, change)), notes := [])[1]
    assert np.argwhere(np.isnan(x_mm).any(axis=2)).tolist() == [[7, 1], [30, 1], [31, 1]]
    assert notes == [f"{value} in tip_1_x, tip_1_y, tip_1_z was taken for no report, in 3 rows."]


def test_a_number_in_all_coordinates_of_all_landmarks_is_no_report(few, tmp_path):
    """Even one that lies among the positions: landmarks cannot coincide."""

    def change(text: str) -> bytes:
        header, *rows = (row.split(",") for row in text.splitlines())
        for i in (30, 31):
            rows[i][1:] = ["0"] * 9
        return "\n".join(map(",".join, [header, *rows])).encode()

    around = replace(few, x_mm=few.x_mm - few.x_mm[:, :1].mean(axis=0))
    x_mm = logs.read_robot(tmp_path, read_mapping(log_of(tmp_path, around, change)), notes := [])[1]
    assert np.flatnonzero(np.isnan(x_mm).all(axis=(1, 2))).tolist() == [30, 31]
    assert notes == ["2 rows with one number in all coordinates of all landmarks were taken for no report."]


@pytest.mark.parametrize("rest", [[5.0, 5.0, 5.0], [0.0, 0.0, 0.0], [40.0, 40.0, 40.0]])
def test_a_tool_that_rests_at_equal_coordinates_is_believed(rest, few, tmp_path):
    """It comes from there in steps, or from nearer than ten times its range."""
    motion = np.linspace(0, 1, len(few.robot_s))[:, None, None] * [5.0, 6.0, -3.0]
    x_mm = np.array(rest) * np.linspace(0, 1, len(few.robot_s)).round()[:, None, None] if rest[0] == 40 else rest + motion
    x_mm = x_mm + [[0, 0, 0], [3, 1, 0], [3, -1, 0]]
    x_mm[:9, 0] = rest
    rested = replace(few, x_mm=x_mm + (0.1 * motion if rest[0] == 40 else 0))
    found = logs.read_robot(tmp_path, read_mapping(log_of(tmp_path, rested, str.encode)), notes := [])[1]
    assert np.isfinite(found).all() and notes == []


def test_a_cut_last_line_and_repeated_rows_are_left_out(few, tmp_path):
    def change(text: str) -> bytes:
        header, *rows = text.splitlines()
        return "\n".join([header, *rows[:9], rows[8], rows[8], *rows[9:], "99.5,1.0,2.0"]).encode()

    mapping = log_of(tmp_path, few, change)
    time, x_mm, *_ = logs.read_robot(tmp_path, read_mapping(mapping), notes := [])
    assert len(time) == len(few.robot_s)
    np.testing.assert_allclose(x_mm, few.x_mm, atol=1e-6)
    cut, repeated = notes
    assert cut == "The last line of log.csv is cut (3 of 10 cells) and was left out."
    assert repeated == "log.csv: 2 rows that repeat the row before were left out."
    (tmp_path / "log.csv").write_text((tmp_path / "log.csv").read_text() + "\n")  # with a line end, the row is wrong, not cut
    with pytest.raises(ValueError, match=r"3 cells where the header has 10"):
        logs.read_robot(tmp_path, read_mapping(mapping), [])


def test_a_table_of_excel_is_read_in_its_encoding(few, tmp_path):
    mapping = log_of(tmp_path, few, lambda text: text.replace("base_x", "Fuß x").encode("cp1252"))
    mapping.write_text(mapping.read_text("utf-8").replace('"base_x"', '"Fuß x"'), "utf-8")
    x_mm = logs.read_robot(tmp_path, read_mapping(mapping), notes := [])[1]
    np.testing.assert_allclose(x_mm, few.x_mm, atol=1e-6)
    assert notes == ["log.csv is not UTF-8 and was read as Windows-1252."]


def test_a_header_of_rostopic_echo_is_read_over_cells_of_text(few, tmp_path):
    def change(text: str) -> bytes:
        header, *rows = (row.replace(",", ",psm1_base,", 1) for row in text.splitlines())
        return "\n".join(["%" + header.replace("psm1_base", "field.header.frame_id"), *rows]).encode()

    x_mm = logs.read_robot(tmp_path, read_mapping(log_of(tmp_path, few, change)), [])[1]
    np.testing.assert_allclose(x_mm, few.x_mm, atol=1e-6)
    lines = logs.uncommented("# 0.1,2.0\n0.2,3.0\n")
    assert lines == ["", "0.2,3.0"]  # a row that is commented out is no header


def test_quaternions_of_one_length_are_normalised(few, tmp_path):
    folder, mapping = source_of(tmp_path, few, foreign.side_by_side, foreign.robot_poses, lambda *_: HINGE)
    expected = logs.read_robot(folder, read_mapping(mapping), [])[2]
    header, *rows = (row.split("\t") for row in (folder / "pose.tsv").read_text().splitlines())
    long = [[*row[:4], *(f"{2.5 * float(cell):.9f}" for cell in row[4:8]), row[8]] for row in rows]
    (folder / "pose.tsv").write_text("\n".join("\t".join(row) for row in [header, *long]))
    np.testing.assert_allclose(logs.read_robot(folder, read_mapping(mapping), notes := [])[2], expected, atol=1e-6)
    assert notes == ["The quaternions in qw, qx, qy, qz have the length 2.5; they were normalised."]


# --- guesses


def test_the_guess_says_what_no_log_is_and_that_a_long_table_is_to_be_pivoted(few, tmp_path):
    folder, _ = source_of(tmp_path, few, foreign.side_by_side)
    (folder / "readme.txt").write_text("left.avi, right.avi: MJPEG, 6 fps\n")
    (folder / "log.npy").write_bytes(b"")
    (folder / "camera.json").write_text('{\n "K": [1, 2]\n}\n')
    with pytest.raises(FileNotFoundError, match=r"no log of a.* It has camera\.json, log\.npy, readme\.txt\. Convert"):
        guess_mapping(folder)
    rows = [f"{t:.3f},{name},{x:.4f},2,3" for t in few.robot_s for x, name in enumerate(("shaft", "left", "right"))]
    (folder / "long.csv").write_text("\n".join(["time_s,landmark,x_mm,y_mm,z_mm", *rows]))
    with pytest.raises(ValueError, match=r"long\.csv: \d+ rows have only \d+ times in 'time_s'; pivot it if rows hold one"):
        guess_mapping(folder)


@pytest.mark.parametrize("name", ["robot.jsonl", "robot.json"])
def test_a_log_of_json_is_read_as_the_table_and_guessed(name, few, tmp_path):
    folder, mapping = source_of(tmp_path, few, foreign.side_by_side, foreign.robot_poses, lambda *_: HINGE)
    expected = logs.read_robot(folder, read_mapping(mapping), [])
    rows = [row.split("\t") for row in (folder / "pose.tsv").read_text().splitlines()[1:]]
    (folder / "pose.tsv").unlink()
    entries = [
        f'{{"header": {{"stamp": {{"secs": {ns[:-9]}, "nsecs": {int(ns[-9:])}}}, "seq": 1}}, "jaw": [{jaw}, null], '
        f'"pose": {{"position": {{"x": {x},"y": {y}, "z": {z}}}, "orientation": {{"x": {i},"y": {j}, "z": {k}, "w": {w}}}}}}}'
        for ns, x, y, z, w, i, j, k, jaw in rows
    ]
    (folder / name).write_text("\n".join(entries) if name == "robot.jsonl" else f"[{', '.join(entries)}]")
    guess = guess_mapping(folder).replace("jaw_mm = [0.0, 0.0, 0.0]", "jaw_mm = [1.0, 0.0, 0.0]")
    mapping.write_text(guess.replace('gripper_unit = "rad"', 'gripper_unit = "deg"'))
    assert read_mapping(mapping).robot.length_unit == "um" and not read_mapping(mapping).labels
    for found, wanted in zip(logs.read_robot(folder, read_mapping(mapping), []), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)
    if name == "robot.jsonl":
        (folder / name).write_text("\n".join([*entries[:-1], entries[-1][:30]]))  # a recorder that was stopped
        time_s = logs.read_robot(folder, read_mapping(mapping), notes := [])[0]
        assert len(time_s) == len(entries) - 1 and notes == ["The last line of robot.jsonl is cut and was left out."]


def test_lists_of_three_in_json_are_guessed_as_positions_and_longer_ones_are_not(few, tmp_path):
    foreign.side_by_side(tmp_path, few)
    names = dict(zip(("joint", "jaw left", "jaw right"), LANDMARKS, strict=True))
    entries = [
        {"t": time, "q": [0.1, 0.2, 0.3, time], **{name: point.tolist() for name, point in zip(names, x, strict=True)}}
        for time, x in zip(few.robot_s, few.x_mm, strict=True)
    ]
    (tmp_path / "log.json").write_text(json.dumps(entries))
    robot = tomllib.loads(guess_mapping(tmp_path))["robot"]
    assert robot["time"] == "t" and robot["length_unit"] == "mm"
    assert robot["landmarks"] == {ours: [f"{name}[{i}]" for i in range(3)] for name, ours in names.items()}


def test_the_guess_finds_the_times_of_two_videos_and_a_german_column(few, tmp_path):
    folder, mapping = source_of(tmp_path, few, foreign.robot_csv)
    for side, name in enumerate(("left.mp4", "right.mp4")):
        foreign.video(folder / name, few.frames[:, side], few.time_s)
    (folder / "stamps.csv").write_text("seq,stamp\n" + "\n".join(f"{i},{t:.3f}" for i, t in enumerate(few.time_s)))
    header, *rows = (folder / "log.csv").read_text().splitlines()
    numbered = [f"Nr.,{header.replace('time_s', 'Zeit')}", *(f"{i},{row}" for i, row in enumerate(rows))]
    (folder / "log.csv").write_text("\n".join(numbered))
    text = guess_mapping(folder)
    assert "CHECK" in next(line for line in text.splitlines() if line.startswith("offset_s"))
    mapping.write_text(text, "utf-8")
    told = read_mapping(mapping)
    assert (told.video.times, told.video.table.file, told.robot.time) == ("table", "stamps.csv", "Zeit")
