"""A first mapping from the files of a folder, with a comment at each line; what could not be found says CHECK."""

import json
import re
from collections import Counter
from pathlib import Path

import av
import numpy as np

from lib.correspondences import LANDMARKS
from lib.importing.labels import labels_of
from lib.importing.logs import read_columns, topics_of
from lib.importing.mapping import Table
from lib.importing.video import IMAGES, VIDEOS, last_number
from lib.recordings.tables import decoded

__all__ = ["guess_mapping"]

_TIME = re.compile(r"(?i)^(t|sec|secs)$|time|stamp|^t[_ \[(]")
_AXIS = re.compile(r"(?i)^(.*?)[ _.\-]?([xyz])[ _]?[\[(]?(mm|um|m)?[\])]?$")
_UNIT = re.compile(r"(?i)(?:^|[ _\[(])(ns|us|ms|s)[\])]?$")
_STEP_S = 1e-4, 0.5  # of a robot's samples, where the unit of time is chosen by it
_REACH_MM = 0.1, 100.0  # from landmark to landmark, where the unit of length is chosen by it
_LABELS = {".slp": ["sleap"], ".csv": ["deeplabcut"], ".json": ["coco", "label_studio"], ".zip": ["cvat"], ".xml": ["cvat"]}
_OFFSET = ("offset_s", "estimate", "t_robot = t_video + offset_s: seconds, or estimate to find it")
_TOOL = [("[tool]", None, ""), ("estimate", True, "from labels; or give landmarks_mm, pivot_s, hinge")]


def guess_mapping(source: str | Path) -> str:
    """The text of a mapping file for the files in a folder.

    Raises:
        FileNotFoundError, ValueError: If there is no video and no image, or no log of a robot that could be read.
    """
    folder = Path(source)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; SOURCE is the folder with your files.")
    paths = {p.relative_to(folder).as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file()}
    labels = {n: p for n, p in paths.items() if p.suffix in set(_LABELS) - {".csv"} or p.stem.startswith("CollectedData")}
    robot, names = _robot(folder, {name: path for name, path in paths.items() if name not in labels})
    lines = [
        ("name", re.sub(r"[<>&]", "_", folder.resolve().name), "any text"),
        ("landmarks", names, "the landmarks' names here; the detector knows base, tip_1, tip_2 of a forceps"),
        ("robot_accuracy_mm", 0.01, "standard deviation of the robot's positions, each coordinate"),
        ("readout_s", 0.0, "rolling shutter: seconds from the first to the last row; 0 is a global shutter"),
    ]
    for title, part in (("video", _video(folder, paths)), ("robot", robot), ("labels", _labels(labels))):
        lines += [(f"[{title}]", None, ""), *part] if part else []
    text = "# What `python3 -m lib import` reads, guessed from the files.  Look at each line; CHECK: not known.\n"
    for key, value, comment in lines:
        text += f"\n{key}\n" if value is None else f"{key} = {_toml(value)}  # {comment}\n"
    return text


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)


def _video(folder: Path, paths: dict[str, Path]) -> list[tuple]:
    films = [name for name, path in paths.items() if path.suffix.lower() in VIDEOS]
    if len(films) == 1:
        with av.open(str(paths[films[0]])) as container:
            width, height = (getattr(container.streams.video[0], side) for side in ("width", "height"))
        sure = "" if width > 2.3 * height or width < 1.1 * height else "; CHECK"
        layout = "top_bottom" if width < 1.1 * height else "side_by_side"
        lines = [("layout", layout, f"two, side_by_side or top_bottom; its frames are {width} x {height} px{sure}")]
        lines += [("file", films[0], "both views")]
    else:
        images = [path for path in paths.values() if path.suffix.lower() in IMAGES]
        kinds = Counter((path.parent, path.suffix) for path in images).most_common(2)
        names = films or [(parent / f"*{suffix}").relative_to(folder).as_posix() for (parent, suffix), _ in kinds]
        if not names:
            raise FileNotFoundError(f"{folder}: no video ({', '.join(VIDEOS)}) and no image files in it.")
        names = names if len(names) > 1 else [names[0].replace("*", f"*{side}*") for side in ("left", "right")]
        names.sort(key=lambda name: ("right" in name.lower(), name))
        lines = [("layout", "two", "one video, or one set of images, a camera")]
        lines += [("left", names[0], "CHECK: the left camera"), ("right", names[1], "the right camera")]
        digits = 0 if films else len(str(max(last_number(path) or 0 for path in images)))
        if digits >= 10:
            unit = {10: "s", 13: "ms", 16: "us"}.get(digits, "ns")
            lines += [("times", "names", "the numbers in the files' names are times"), ("name_unit", unit, "their unit")]
        elif not films:
            lines += [("times", "fps", "container, names, table or fps"), ("fps", 25.0, "CHECK: frames a second")]
    return [*lines, ("exchanged", False, "true exchanges the two cameras")]


def _robot(folder: Path, paths: dict[str, Path]) -> tuple[list[tuple], tuple[str, ...]]:
    tables = {name: path for name, path in paths.items() if path.suffix.lower() in (".csv", ".tsv", ".txt")}
    bags = [name for name, path in paths.items() if path.suffix in (".bag", ".db3", ".mcap")]
    bags = [name.rpartition("/")[0] if (folder / name).with_name("metadata.yaml").exists() else name for name in bags]
    if bags or not tables:
        return _bag(folder, bags)
    name = max(tables, key=lambda name: tables[name].stat().st_size)
    rows = [line for line in decoded(tables[name], utf_16=True).splitlines() if line.strip() and line.lstrip()[0] not in "#%"]
    separator = max("\t;,|", key=rows[0].count)
    header = [cell.strip() for cell in rows[0].split(separator)]
    time = next((cell for cell in header if _TIME.search(cell)), header[0])
    dated = ":" in rows[1].split(separator)[header.index(time)]
    unit = "iso" if dated else match[1].lower() if (match := _UNIT.search(time)) else ""
    decimal = "," if separator != "," and re.search(r"\d,\d", rows[1]) else "."
    quaternion = tuple(next((cell for cell in header if re.search(rf"(?i)q_?{axis}$", cell)), "") for axis in "xyzw")
    groups: dict[str, dict[str, str]] = {}
    for cell in header:
        if (match := _AXIS.match(cell)) and cell not in (*quaternion, time):
            groups.setdefault(match[1], {})[match[2].lower()] = cell
    whole = {prefix: tuple(axes[axis] for axis in "xyz") for prefix, axes in groups.items() if set(axes) == set("xyz")}
    if not whole:
        raise ValueError(f"{tables[name]}: no three columns end in x, y and z; it has {header}. Write the mapping by hand.")
    table = Table(file=name, separator=separator, decimal=decimal, time=time, time_unit=unit or "s")
    stamps, columns = read_columns(tables[name], table, [cell for group in whole.values() for cell in group])
    one, *more = (np.stack([columns[cell] for cell in group], axis=-1) for group in whole.values())
    reach = np.nanmedian(np.linalg.norm(more[0] - one, axis=1)) if more else np.nanmax(np.nanstd(one, axis=0))
    step = float(np.median(np.abs(np.diff([float(t - stamps[0]) for t in stamps]))))
    units = {"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    unit = unit or next((u for u, scale in units.items() if _STEP_S[0] <= step * scale <= _STEP_S[1]), "s")
    lengths = [u for u, scale in (("mm", 1), ("m", 1e3), ("um", 1e-3)) if _REACH_MM[0] <= reach * scale <= _REACH_MM[1]]
    told = next((m[3].lower() for group in whole.values() if (m := _AXIS.match(group[0])) and m[3]), "")
    lines = [
        ("file", name, "the robot's log"), ("separator", separator, "between cells"), ("decimal", decimal, "decimal mark"),
        ("time", time, "column of the robot's times"), ("time_unit", unit, "s, ms, us, ns, or iso for dates"),
        ("length_unit", told or (lengths or ["mm"])[0], "m, mm or um" + ("" if told or lengths else "; CHECK")),
    ]  # fmt: skip
    if all(quaternion) or len(whole) == 1:
        prefix = min(whole, key=lambda prefix: "pos" not in prefix.lower())
        pose = {"position": whole[prefix], "rotation": quaternion, "rotation_kind": "quaternion_xyzw"}
        if jaw := next((cell for cell in header if re.search(r"(?i)grip|jaw|open", cell)), ""):
            pose |= {"gripper": jaw, "gripper_unit": next((u for u in ("deg", "mm") if u in jaw.lower()), "rad")}
        pose_line = ("pose", pose, "CHECK: columns of the tool's pose, and of the full angle between its jaws")
        return [*lines, pose_line, _OFFSET, *_TOOL], LANDMARKS
    names, matched = _matched(list(whole))
    return [*lines, ("landmarks", {n: whole[matched[n]] for n in names}, "CHECK: columns of each landmark"), _OFFSET], names


def _bag(folder: Path, bags: list[str]) -> tuple[list[tuple], tuple[str, ...]]:
    if not bags:
        raise FileNotFoundError(f"{folder}: no log of a robot in it (.csv, .tsv, .txt, or a ROS bag).")
    kinds = topics_of(folder / bags[0])
    lines = [("file", bags[0], "the robot's log"), ("length_unit", "m", "m, mm or um; ROS counts in m"), _OFFSET]
    points = [topic for topic, kind in kinds.items() if kind == "PointStamped"]
    poses = [topic for topic, kind in kinds.items() if kind == "PoseStamped"]
    if not poses and len(points) < 2:
        raise ValueError(f"{folder / bags[0]}: no PoseStamped, no two PointStamped; it has {kinds}. Write it by hand.")
    clock = (points if len(points) > 1 else poses)[0]
    lines += [("time", f"{clock}:header.stamp", "a topic, and its field of times; or :received")]
    if len(points) > 1:
        names, matched = _matched(points)
        columns = {name: tuple(f"{matched[name]}:point.{axis}" for axis in "xyz") for name in names}
        return [*lines, ("landmarks", columns, "CHECK: fields of each landmark")], names
    pose = {"position": tuple(f"{poses[0]}:pose.position.{axis}" for axis in "xyz")}
    pose |= {"rotation": tuple(f"{poses[0]}:pose.orientation.{axis}" for axis in "xyzw"), "rotation_kind": "quaternion_xyzw"}
    return [*lines, ("pose", pose, "CHECK: fields of the tool's pose; gripper = ... its opening"), *_TOOL], LANDMARKS


def _matched(theirs: list[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Our names, and theirs for each: alike but for case and signs, else in their order."""
    bare = {name: re.sub(r"[^a-z0-9]", "", name.lower()) for name in (*theirs, *LANDMARKS)}
    if len(theirs) != len(LANDMARKS):
        names = tuple(f"point_{bare[name]}" for name in theirs)
        return names, dict(zip(names, theirs, strict=True))
    found = {name: next((t for t in theirs if bare[name] in bare[t]), None) for name in LANDMARKS}
    rest = [t for t in theirs if t not in found.values()]
    return LANDMARKS, {name: t or rest.pop(0) for name, t in found.items()}


def _labels(paths: dict[str, Path]) -> list[tuple]:
    for file, path in paths.items():
        for kind in _LABELS[path.suffix] if path.suffix in _LABELS else []:
            try:
                found = list(dict.fromkeys(label.name for label in labels_of(kind, path)))
            except (ValueError, OSError):
                found = []
            if found:
                origin = "corner" if kind in ("cvat", "label_studio") else "centre"
                where = "what (0, 0) is in the top left pixel: its centre, or its corner as CVAT and Label Studio draw"
                lines = [("kind", kind, "coco, cvat, label_studio, deeplabcut or sleap"), ("file", file, "both cameras")]
                lines += [("names", _matched(found)[1], "CHECK: their name of each landmark")]
                lines += [("pixel_origin", origin, where)]
                return [*lines, ("first_frame", 0, "number of the first frame in the labels' image names")]
    return []
