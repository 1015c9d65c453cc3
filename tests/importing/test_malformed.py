"""What is wrong with a source is told in one error that names file and cure; the source stays, and nothing is written."""

import errno
import json
import re
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from lib.importing import guess_mapping, import_recording, read_mapping
from lib.recordings import Recording
from tests.importing import foreign
from tests.importing.test_import import HINGE, content, thinned

MAKERS = foreign.side_by_side, foreign.robot_csv, foreign.labels_coco


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A valid source of six frames, and the mapping's text."""
    folder = tmp_path_factory.mktemp("good") / "source"
    folder.mkdir()
    whole = thinned(foreign.shipped(), 40)
    few = replace(whole, frames=whole.frames[:6], time_s=whole.time_s[:6], labels=_first(whole.labels, 6))
    text = 'name = "eye"\n' + "".join(maker(folder, few) for maker in MAKERS)
    foreign.labels_cvat(folder, few)
    foreign.robot_poses(folder, few)
    return folder, text


def _first(labels, n: int):
    return replace(labels, **{name: getattr(labels, name)[:n] for name in (
        "u_left", "u_right", "visibility_left", "visibility_right")})  # fmt: skip


def edit(name: str, change):
    """A change of a text file of the source."""

    def apply(folder: Path, text: str) -> str:
        path = folder / name
        path.write_text(change(path.read_text("utf-8")), "utf-8")
        return text

    return apply


def as_json(content: str):
    """A log of JSON instead, which the mapping names."""

    def apply(folder: Path, text: str) -> str:
        (folder / "log.jsonl").write_text(content)
        return text.replace("log.csv", "log.jsonl")

    return apply


def told(old: str, new: str):
    """A change of the mapping."""

    def apply(folder: Path, text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return apply


def line(number: int, change):
    def apply(text: str) -> str:
        lines = text.splitlines()
        lines[number] = change(lines[number], lines)
        return "\n".join(lines) + "\n"

    return edit("log.csv", apply)


def cut(folder: Path, text: str) -> str:
    """A Matroska file states its length at the start; a bad copy lacks its end."""
    foreign.cut(folder / "stereo.mp4", folder / "cut.mkv")
    data = (folder / "cut.mkv").read_bytes()
    (folder / "cut.mkv").write_bytes(data[: len(data) // 2])
    return text.replace("stereo.mp4", "cut.mkv")


def no_index(folder: Path, text: str) -> str:
    data = (folder / "stereo.mp4").read_bytes()
    (folder / "stereo.mp4").write_bytes(data[: 2 * len(data) // 3])  # the index of an .mp4 stands at its end
    return text


def sound(folder: Path, text: str) -> str:
    with av.open(str(folder / "stereo.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return text


def zipped(*entries: str):
    def apply(folder: Path, text: str) -> str:
        with zipfile.ZipFile(folder / "bad.zip", "w") as archive:
            for entry in entries:
                archive.writestr(entry, "<annotations/>")
        return text.split("[labels]")[0] + '[labels]\nkind = "cvat"\nfile = "bad.zip"\n'

    return apply


def cvat(content: str):
    def apply(folder: Path, text: str) -> str:
        (folder / "bad.xml").write_text(content, "utf-8")
        return text.split("[labels]")[0] + '[labels]\nkind = "cvat"\nfile = "bad.xml"\n'

    return apply


def coco(change):
    def apply(text: str) -> str:
        content = json.loads(text)
        change(content)
        return json.dumps(content)

    return edit("person_keypoints.json", apply)


def percent(content: dict) -> None:
    for entry in content["annotations"]:
        entry["keypoints"] = [v / 10 if i % 3 < 2 else v for i, v in enumerate(entry["keypoints"])]


def images(change):
    """Two folders of images in place of the video."""

    def apply(folder: Path, text: str) -> str:
        for side in ("left", "right"):
            (folder / side).mkdir()
            for i in range(6):
                cv2.imwrite(str(folder / side / f"{i:03d}.png"), np.full((134, 240), 40 * i, np.uint8))
        change(folder)
        video = '[video]\nlayout = "two"\nleft = "left/*"\nright = "right/*"\ntimes = "fps"\nfps = 25\n'
        return text.split("[video]")[0] + video + "[robot]" + text.split("[robot]")[1].split("[labels]")[0]

    return apply


def deep(folder: Path) -> None:
    for side in ("left", "right"):
        for i in range(6):
            cv2.imwrite(str(folder / side / f"{i:03d}.png"), np.full((134, 240), 1000 + 900 * (i == 3), np.uint16))


def ten_bits(folder: Path, text: str) -> str:
    return images(deep)(folder, text).replace("fps = 25", "fps = 25\nbit_depth = 10")


def other_size(folder: Path) -> None:
    cv2.imwrite(str(folder / "right/003.png"), np.zeros((60, 80), np.uint8))


def smaller_left(folder: Path) -> None:
    for path in (folder / "left").iterdir():
        cv2.imwrite(str(path), np.zeros((60, 80), np.uint8))


def repeated_frame_time(folder: Path, text: str) -> str:
    (folder / "t.csv").write_text("stamp\n" + "\n".join(f"{0.04 * min(i, 4):.2f}" for i in range(6)))
    return text.replace("[video]\n", '[video]\ntimes = "table"\ntable = { file = "t.csv", time = "stamp" }\n')


def no_rotation(folder: Path, text: str) -> str:
    path = folder / "pose.tsv"
    header, *rows = [row.split("\t") for row in path.read_text().splitlines()]
    path.write_text("\n".join("\t".join(row) for row in [header, *([*row[:4], *"0000", row[8]] for row in rows)]))
    return pose()(folder, text)


def no_bag(folder: Path, text: str) -> str:
    (folder / "x.bag").write_bytes(b"no bag")
    return text.replace("log.csv", "x.bag").replace("time_s", "/tool:received")


SEVERAL = '<annotations><image name="left/0.png"><points label="joint" points="1,2;3,4"/></image></annotations>'


def pose(tool: str = HINGE, old: str = "", new: str = ""):
    def apply(folder: Path, text: str) -> str:
        return text.split("[robot]")[0] + foreign.POSES.replace(old, new, 1) + tool + "[labels]" + text.split("[labels]")[1]

    return apply


def shut(folder: Path, text: str) -> str:
    path = folder / "pose.tsv"
    path.write_text("".join(row if i == 0 else row.rpartition("\t")[0] + "\t20.0\n"
                            for i, row in enumerate(path.read_text().splitlines(keepends=True))))  # fmt: skip
    return pose(tool="[tool]\nestimate = true\n")(folder, text)


def rounded_times(folder: Path, text: str) -> str:
    header, *rows = (folder / "log.csv").read_text("utf-8").splitlines()
    cells = [row.split(",", 1) for row in rows]
    (folder / "log.csv").write_text("\n".join([header, *(f"{float(t):.0f},{rest}" for t, rest in cells)]), "utf-8")
    return text


def wrong_rotation(folder: Path, text: str) -> str:
    lines = (folder / "pose.tsv").read_text().splitlines()
    cells = lines[7].split("\t")
    lines[7] = "\t".join([*cells[:4], "2", "0", "0", "0", cells[8]])
    (folder / "pose.tsv").write_text("\n".join(lines))
    return pose()(folder, text)


def bytes_of(name: str, data: bytes):
    def apply(folder: Path, text: str) -> str:
        (folder / name).write_bytes(data)
        return text

    return apply


def labels(kind: str, name: str, data: bytes = b"\x00garbage"):
    def apply(folder: Path, text: str) -> str:
        (folder / name).write_bytes(data)
        return text.split("[labels]")[0] + f'[labels]\nkind = "{kind}"\nfile = "{name}"\n'

    return apply


def entry(time: object) -> str:
    return json.dumps({"time_s": time} | {f"{name}_{axis}": 1.0 for name in ("base", "tip_1", "tip_2") for axis in "xyz"})


SPOILT = {
    "truncated video": (no_index, r"stereo\.mp4: the video cannot be opened.*[Cc]opy it again"),
    "truncated video without an index": (cut, r"cut\.mkv.*(cut off|cannot be decoded|damaged).*[Cc]opy"),
    "no video": (sound, r"stereo\.mp4: no video of a known codec.*Convert"),
    "a text called .mp4": (bytes_of("stereo.mp4", b"no video at all" * 99), r"stereo\.mp4: the video cannot be opened"),
    "missing video": (told("stereo.mp4", "other.mp4"), r"other\.mp4: no such video"),
    "wrong separator": (told("[robot]\n", '[robot]\nseparator = ";"\n'), r"log\.csv, line 1: no column.*separator = ';'"),
    "missing column": (edit("log.csv", lambda t: t.replace("tip_1_y", "tip_1_why")),
        r"log\.csv, line 1: no column.*'tip_1_y'"),
    "repeated column": (edit("log.csv", lambda t: t.replace("tip_1_y", "tip_1_x")), r"log\.csv, line 1: two columns"),
    "short row": (line(7, lambda row, _: row.rsplit(",", 1)[0]), r"log\.csv, line 8: 9 cells where the header has 10"),
    "text in a cell": (line(7, lambda row, _: row.rsplit(",", 1)[0] + ",off"), r"log\.csv, line 8, column tip_2_z: 'off'"),
    "infinity": (line(7, lambda row, _: row.rsplit(",", 1)[0] + ",inf"), r"log\.csv, line 8.*not a finite number"),
    "decimal commas": (line(7, lambda row, _: row.replace(".", ",")), r"log\.csv, line 8: 20 cells.*decimal"),
    "no time": (line(7, lambda row, _: "," + row.split(",", 1)[1]), r"log\.csv, line 8, column time_s: '' is not a time"),
    "decreasing times": (line(7, lambda row, lines: lines[2]), r"log\.csv, line 8: the time goes back \(.*Sort"),
    "repeated times": (line(7, lambda row, lines: lines[6].rsplit(",", 1)[0] + ",1"),
        r"log\.csv, line 8: the time repeats \(.*drop"),
    "rounded times": (rounded_times, r"log\.csv, line \d: the time repeats .* rounded to 1 s\. .*more digits; .*spread"),
    "empty log": (edit("log.csv", lambda t: t.splitlines()[0] + "\n"), r"log\.csv: the table has no row"),
    "not UTF-8": (bytes_of("log.csv", b"time_s,\x81\n"), r"log\.csv, line 1: the text is not UTF-8"),
    "NumPy": (told("log.csv", "log.npy"), r"log\.npy: only CSV tables, JSON .* and ROS bags .* Convert it to CSV, one row"),
    "broken JSON": (as_json('{"t": 1.0}\n{"t": 2\n{"t": 3}'), r"log\.jsonl, line 2: not JSON \(.*\)\. Write one"),
    "JSON of numbers": (as_json("[1, 2]"), r"log\.jsonl: JSON needs one object a line.* Write it so, or as CSV"),
    "JSON by columns": (as_json('{"t": [1, 2], "x": [3, 4]}'), r"log\.jsonl: JSON needs one object a line"),
    "JSON over many lines": (as_json(json.dumps([{"t": 1}] * 2, indent=1)[1:-1]), r"log\.jsonl, line 2: not JSON"),
    "JSON without a column": (as_json('{"t": 1.0}\n' * 2), r"log\.jsonl: no column is called 'time_s'; it has \['t'\]"),
    "text in JSON": (as_json(f"{entry(1.0)}\n\n{entry('late')}\n"), r"log\.jsonl, line 3, column time_s: 'late"),
    "metres called mm": (edit("log.csv", lambda t: _scaled(t, 1e-3)), r"log\.csv.*length_unit"),
    "mm called metres": (told('length_unit = "mm"', 'length_unit = "m"'), r"log\.csv.*moves over .* mm.*length_unit"),
    "ms called s": (edit("log.csv", lambda t: _scaled(t, 1e3, times=True)), r"log\.csv: entries are 400 s apart.*time_unit"),
    "seconds called us": (told("[robot]\n", '[robot]\ntime_unit = "us"\n'),
        r"log\.csv: entries are 4e-07 s apart.*time_unit"),
    "clocks apart": (told("[robot]\n", "[robot]\noffset_s = 500\n"),
        r"log\.csv: its times \(.*frames \(.*\) do not overlap\. "
        r"If the log is of the same run, set robot\.offset_s \(now 500\.0\) in .*map\.toml to a number from -?\d"
        r".*overlap \(.*\)\.$"),
    "a dated log": (edit("log.csv", lambda t: re.sub(r"(?m)^-?[\d.]+", lambda m: f"{1.7e9 + float(m[0]):.3f}", t)),
        r"log\.csv: its times \(1.*do not overlap.*map\.toml .*or to \"estimate\" if log and video"),
    "an image of 16 bits among others": (images(lambda f: cv2.imwrite(
        str(f / "left/003.png"), np.full((134, 240), 1900, np.uint16))),
        r"left/\d+\.png: 16-bit values up to 1900, and no bit_depth is stated\. .*video\.bit_depth in an import's mapping"),
    "too few for a clock": (told("[robot]\n", '[robot]\noffset_s = "estimate"\n'),
        r"robot\.offset_s, searched from -0\.500 to 0\.500 s: . frames lie inside .*robot\.search_s = 0\.5"),
    "not COCO": (bytes_of("person_keypoints.json", b"[1, 2"), r"person_keypoints\.json: not COCO keypoints"),
    "per cent": (coco(percent), r"person_keypoints\.json: no label beyond .* per cent"),
    "missing category": (coco(lambda c: c.update(categories=[])), r"names category 7.*does not describe"),
    "unknown landmark": (told("jaw left", "jaw lift"), r"no label is called 'jaw lift'; it has \['jaw left'"),
    "labels of other frames": (told("[labels]\n", "[labels]\nfirst_frame = 900\n"), r"none of its .* labels belongs"),
    "label outside": (coco(lambda c: c["annotations"][3].update(keypoints=[241, 5, 2] * 3)),
        r"lies outside the image of 240"),
    "labelled twice": (coco(lambda c: c["annotations"].append(c["annotations"][0])), r"labelled twice"),
    "zip that leads out": (zipped("annotations.xml", "../../evil.xml"), r"bad\.zip: it holds '\.\./\.\./evil\.xml'"),
    "zip without labels": (zipped("readme.txt"), r"bad\.zip: not CVAT"),
    "XML with entities": (cvat('<!DOCTYPE a [<!ENTITY b "c">]><annotations/>'), r"bad\.xml: the XML defines entities"),
    "cut XML": (cvat("<annotations><image"), r"bad\.xml: not CVAT"),
    "several points": (cvat(SEVERAL), r"bad\.xml: .*several points"),
    "not SLEAP": (labels("sleap", "x.slp"), r"x\.slp: not a \.slp file"),
    "an analysis file of SLEAP": (labels("sleap", "x.analysis.h5"), r"x\.analysis\.h5: of SLEAP only \.slp is read.*Name"),
    "not DeepLabCut": (labels("deeplabcut", "CollectedData_x.csv", b"a,b\n1,2\n"),
        r"CollectedData_x\.csv: not labels of DeepLabCut"),
    "not Label Studio": (labels("label_studio", "x.json", b'[{"data": 3}]'), r"x\.json: not JSON of Label Studio"),
    "not a bag": (no_bag, r"x\.bag: the bag cannot be read"),
    "images of two sizes": (images(other_size),
        r"right/003\.png: it has 80 x 60 px, but the frames before it 240 x 134 px\. Export"),
    "cameras of two sizes": (images(smaller_left),
        r"right/000\.png: left and right frames differ in size \(80 x 60 px and 240 x 134 px\)"),
    "a repeated time of a frame": (repeated_frame_time,
        r"t\.csv, line 7: the time repeats \(0\.16 s, then 0\.16 s\)\. Sort"),
    "no rotation at all": (no_rotation,
        r"robot\.pose: no row has both a position and a rotation in px, .*, qz \(.*\)\. Name other columns of pose\.tsv"),
    "a readout longer than a frame": (told('"eye"\n', '"eye"\nreadout_s = 2\n'),
        r"^[^ ]*map\.toml: readout_s = 2\.0 must lie between 0 and one frame"),
    "a damaged image": (images(lambda f: (f / "left/002.png").write_bytes(b"\x89PNG no")),
        r"left/002\.png: the image is corrupt"),
    "a missing image": (images(lambda f: shutil.rmtree(f / "right")), r"right/\*: no image"),
    "names without numbers": (images(lambda f: (f / "left/003.png").rename(f / "left/c.png")),
        r"left/c\.png: the name holds no number"),
    "brighter than told": (ten_bits, r"\d\.png: 16-bit values up to 1900, more than bit_depth = 10"),
    "a script in a name": (told('"eye"', '"<script>alert(1)</script>"'), r"map\.toml: name = .*should match"),
    "an axis named twice": (told('"tip_1_z"', '"tip_1_y"'), r"map\.toml: robot: the column 'tip_1_y' is named twice"),
    "a landmark named twice": (told('"tip_2_x", "tip_2_y", "tip_2_z"', '"tip_1_x", "tip_1_y", "tip_1_z"'),
        r"map\.toml: robot: the column 'tip_1_x' is named twice"),
    "a rotation named as position": (pose(old='"qw", "qx"', new='"px", "qx"'), r"robot: the column 'px' is named twice"),
    "a misspelt key": (told("[robot]\n", '[robot]\nlenght_unit = "m"\n'),
        r"map\.toml: robot\.lenght_unit = 'm': no such key here; the nearest one is length_unit\."),
    "a misspelt key in place of a required one": (told("length_unit", "lenght_unit"),
        r"map\.toml: robot\.lenght_unit = 'mm': no such key here; the nearest one is length_unit\."),
    "a key of another section": (told("[robot]\n", "[robot]\nexchanged = true\n"),
        r"map\.toml: robot\.exchanged = True: no such key here; it belongs to \[video\]\."),
    "a key like no other": (told("[robot]\n", "[robot]\nzqj = 1\n"), r"map\.toml: robot\.zqj = 1: no such key here\. data/"),
    "a misspelt estimate": (told("[robot]\n", '[robot]\noffset_s = "estimated"\n'),
        r"robot\.offset_s = 'estimated': a number of seconds is needed, or the word \"estimate\"\."),
    "a missing key": (told('length_unit = "mm"\n', ""), r"map\.toml: robot\.length_unit: Field required"),
    "not TOML": (told("[robot]", "[robot"), r"map\.toml: not valid TOML"),
    "unfit rotations": (pose(old='"px", "py", "pz"]\nrotation = ["qw"', new='"qw", "py", "pz"]\nrotation = ["px"'),
        r"pose\.tsv, line 2: columns px, qx, .* are no quaternion_wxyz: -?[\d.]+, .*\. Check rotation_kind"),
    "a wrong rotation": (wrong_rotation, r"pose\.tsv, line 8: columns qw, qx, qy, qz are no quat.*: 2, 0, 0, 0 "
        r"\(lengths vary from 1 to 2; .* normalise them\)\. Check rot"),
    "a tip elsewhere": (edit("log.csv", lambda t: _scaled(t, 100, column=4)),
        r"log\.csv, read with .*map\.toml: the median distances from base are \d+ to tip_1, [23]\.\d+ to tip_2, "
        r"not plausible in mm \(0\.25 to 100\)\. Check the columns\."),
    "an empty landmark": (edit("log.csv", lambda t: re.sub(r"(?m)^(-?\d.*)(,[^,]*){3}$", r"\1,,,", t)),
        r"log\.csv: no row has a value in tip_2_x, tip_2_y, tip_2_z\. Name other columns"),
    "degrees called radians": (pose(old='gripper_unit = "deg"', new='gripper_unit = "rad"'),
        r"pose\.tsv: the gripper opens to .* gripper_unit"),
    "no tool geometry": (pose(tool=""),
        r"the position of base, tip_1, tip_2 in the tool frame is not given; give tool\.landmarks_mm"),
    "a jaw along its hinge": (pose(tool=HINGE.replace("axis = [0, 0, 1]", "axis = [1, 0, 0]")),
        r"the jaw lies along the axis"),
    "jaws that never open": (shut, r"tool\.estimate, with offset_s = 1700000000\.0: "
        r"the jaws open by only 0 rad, which does not determine the hinge"),
}  # fmt: skip


def _scaled(text: str, factor: float, times: bool = False, column: int | None = None) -> str:
    header, *rows = text.splitlines()
    cells = [[float(cell) for cell in row.split(",")] for row in rows]
    scaled = [k == column if column else (k == 0) == times for k in range(len(cells[0]))]
    cells = [[v * factor if scales else v for v, scales in zip(row, scaled, strict=True)] for row in cells]
    return "\n".join([header, *(",".join(f"{v:.9f}" for v in row) for row in cells)]) + "\n"


@pytest.mark.parametrize("case", SPOILT)
def test_a_spoilt_source_is_refused_in_one_line(case, good, tmp_path):
    spoil, expected = SPOILT[case]
    folder = shutil.copytree(good[0], tmp_path / "a source ü")
    text = spoil(folder, good[1])
    mapping = tmp_path / "map.toml"
    mapping.write_text(text, "utf-8")
    before = content(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=expected) as caught:
        import_recording(folder, mapping, tmp_path / "out")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700 and ".partial" not in str(caught.value)
    assert content(folder) == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a source ü", "map.toml"]


def test_a_full_disk_and_a_read_only_place_leave_nothing(good, tmp_path, monkeypatch):
    (tmp_path / "map.toml").write_text(good[1], "utf-8")
    write, count = Path.write_bytes, []

    def full(path: Path, data: bytes) -> int:
        count.append(path)
        if len(count) > 5:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        import_recording(good[0], tmp_path / "map.toml", tmp_path / "out")
    monkeypatch.undo()

    def refused(path: Path, *args: object, **options: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(PermissionError, match="Permission denied"):
        import_recording(good[0], tmp_path / "map.toml", tmp_path / "out")
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["map.toml"]


def test_what_is_there_stays(good, tmp_path):
    mapping = tmp_path / "map.toml"
    mapping.write_text(good[1], "utf-8")
    (tmp_path / "thesis").mkdir()
    with pytest.raises(FileExistsError, match="exists already"):
        import_recording(good[0], mapping, tmp_path / "thesis")
    with pytest.raises(FileExistsError, match="is not a recording and is left alone"):
        import_recording(good[0], mapping, tmp_path / "thesis", overwrite=True)
    with pytest.raises(ValueError, match="lies in the source"):
        import_recording(good[0], mapping, good[0] / "out")
    with pytest.raises(ValueError, match="holds your files, and --overwrite replaces all of it; choose another --out"):
        import_recording(good[0], mapping, good[0].parent, overwrite=True)
    with pytest.raises(ValueError, match="holds your files"):
        import_recording(good[0], mapping, tmp_path, overwrite=True)
    with pytest.raises(FileNotFoundError, match="no such folder"):
        import_recording(tmp_path / "nowhere", mapping, tmp_path / "out")
    with pytest.raises(FileNotFoundError, match="--guess --map none.toml"):
        read_mapping(tmp_path / "none.toml")


@pytest.mark.parametrize("change", ["BOM", "CRLF", "UTF-16", "comments", "numpy", "ISO dates"])
def test_harmless_dialects_are_read(change, good, tmp_path):
    folder = shutil.copytree(good[0], tmp_path / "source")
    unit = '[robot]\ntime_unit = "iso"' if "ISO" in change else "[robot]"
    (tmp_path / "map.toml").write_text(good[1].replace("[robot]", unit))
    text = (folder / "log.csv").read_text()
    header, rows = text.splitlines()[0], [row.partition(",") for row in text.splitlines()[1:]]
    data = {
        "BOM": text.encode("utf-8-sig"), "CRLF": text.replace("\n", "\r\n").encode(), "UTF-16": text.encode("utf-16"),
        "comments": b"# made by a robot\n\n" + text.encode(),
        "numpy": b"# made by a robot\n# " + text.encode(),
        "ISO dates": "\n".join([header, *(f"1970-01-01T00:00:{float(t) + 1:09.6f}Z,{rest}" for t, _, rest in rows)]).encode(),
    }[change]  # fmt: skip
    (folder / "log.csv").write_bytes(data)
    (folder / "pose.tsv").unlink()
    assert change not in ("comments", "numpy") or 'time = "time_s"' in guess_mapping(folder)
    import_recording(folder, tmp_path / "map.toml", tmp_path / "out")
    recording = Recording.open(tmp_path / "out")
    assert len(recording) == 6 and len(recording.kinematics.time_s) == 110
