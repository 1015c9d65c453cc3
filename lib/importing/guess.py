"""A first mapping from the files of a folder, with a comment at each line; what could not be found says CHECK."""

import json
import re
from collections import Counter
from pathlib import Path

import av
import numpy as np

from lib.correspondences import LANDMARKS
from lib.importing.labels import READERS
from lib.importing.logs import decoded, read_columns
from lib.importing.mapping import Table
from lib.importing.video import IMAGES, VIDEOS, last_number

__all__ = ["guess_mapping"]

_TIME = re.compile(r"(?i)^(t|sec|secs)$|time|stamp|^t[_ \[(]")
_AXIS = re.compile(r"(?i)^(.*?)[ _.\-]?([xyz])[ _]?[\[(]?(mm|um|m)?[\])]?$")
_UNIT = re.compile(r"(?i)(?:^|[ _\[(])(ns|us|ms|s|sec|nsec)[\])]?$")
_STEP_S = 1e-4, 0.5  # of a robot's samples, where the unit of time is chosen by it
_REACH_MM = 0.1, 100.0  # from landmark to landmark, where the unit of length is chosen by it
_TOPICS = {"PointStamped": "point", "PoseStamped": "pose", "TransformStamped": "transform"}


def guess_mapping(source: str | Path) -> str:
    """The text of a mapping file for the files in a folder.

    Raises:
        FileNotFoundError: If there is no such folder, no video and no images in it, or no log of a robot.
    """
    folder = Path(source)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; SOURCE is the folder with your files.")
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    labels = _labels(folder, paths)
    robot, names = _robot(folder, [path for path in paths if not _is_label(path)])
    lines = [
        ("name", folder.resolve().name if re.fullmatch(r"[^<>&]+", folder.resolve().name) else "recording", "any text"),
        ("landmarks", names, "the landmarks' names here; the detector knows base, tip_1, tip_2 of a forceps"),
        ("robot_accuracy_mm", 0.01, "standard deviation of the robot's positions, each coordinate"),
        ("readout_s", 0.0, "rolling shutter: seconds from the first to the last row; 0 is a global shutter"),
    ]
    for title, part in (("video", _video(folder, paths)), ("robot", robot), ("labels", labels)):
        lines += [(f"[{title}]", None, ""), *part] if part else []
    text = "# What `python3 -m lib import` reads, guessed from the files.  Look at each line; CHECK: not known.\n"
    for key, value, comment in lines:
        text += f"\n{key}\n" if value is None else f"{key} = {_toml(value)}  # {comment}\n"
    return text


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)


def _video(folder: Path, paths: list[Path]) -> list[tuple]:
    found = [path for path in paths if path.suffix.lower() in VIDEOS]
    if len(found) == 1:
        with av.open(str(found[0])) as container:
            stream = container.streams.video[0]
            ratio = stream.width / stream.height
        layout = "side_by_side" if ratio > 2.3 else "top_bottom" if ratio < 1.1 else "side_by_side"
        sure = f"its frames are {stream.width} x {stream.height} px" + ("; CHECK" if 1.1 <= ratio <= 2.3 else "")
        lines = [("layout", layout, f"two, side_by_side or top_bottom; {sure}")]
        lines += [("file", _name(folder, found[0]), "both views")]
        exchanged = "true if the first half is the right camera"
    elif len(found) > 1:
        left, right = _by_side([_name(folder, path) for path in found])
        lines = [("layout", "two", "one video a camera")]
        lines += [("left", left, "CHECK: the left camera"), ("right", right, "the right one")]
        exchanged = "true exchanges the two cameras"
    else:
        images = Counter((path.parent, path.suffix) for path in paths if path.suffix.lower() in IMAGES)
        if not images:
            raise FileNotFoundError(f"{folder}: no video ({', '.join(VIDEOS)}) and no image files in it.")
        patterns = [f"{_name(folder, parent)}/*{suffix}".removeprefix("./") for (parent, suffix), _ in images.most_common(2)]
        if len(patterns) == 1:
            patterns = [patterns[0].replace("*", "*left*"), patterns[0].replace("*", "*right*")]
        left, right = _by_side(sorted(patterns))
        lines = [("layout", "two", "one set of images a camera")]
        lines += [("left", left, "CHECK: pattern of the left camera's files")]
        lines += [("right", right, "of the right camera's files")]
        exchanged = "true exchanges the two cameras"
        numbers = [last_number(path) or 0 for path in paths if path.suffix.lower() in IMAGES]
        digits = len(str(max(numbers)))
        if digits >= 10:
            unit = {10: "s", 13: "ms", 16: "us"}.get(digits, "ns")
            lines += [("times", "names", "the numbers in the files' names are times"), ("name_unit", unit, "their unit")]
        else:
            lines += [("times", "fps", "container, names, table or fps"), ("fps", 25.0, "CHECK: frames a second")]
    return [*lines, ("exchanged", False, exchanged)]


def _name(folder: Path, path: Path) -> str:
    return path.relative_to(folder).as_posix()


def _by_side(names: list[str]) -> tuple[str, str]:
    for one, other in (("left", "right"), ("_l", "_r"), ("L", "R"), ("0", "1"), ("1", "2")):
        lefts, rights = ([n for n in names if key in n and (key in ("L", "R") or key in n.lower())] for key in (one, other))
        if lefts and rights and lefts[0] != rights[0]:
            return lefts[0], rights[0]
    return names[0], names[1]


def _robot(folder: Path, paths: list[Path]) -> tuple[list[tuple], tuple[str, ...]]:
    bags = [path for path in paths if path.suffix in (".bag", ".db3", ".mcap")]
    if bags:
        return _bag(folder, bags[0])
    tables = [path for path in paths if path.suffix.lower() in (".csv", ".tsv", ".txt")]
    tables = [path for path in tables if len(decoded(path).splitlines()) > 2]
    if not tables:
        raise FileNotFoundError(f"{folder}: no log of a robot in it (.csv, .tsv, .txt, or a ROS bag).")
    path = max(tables, key=lambda path: path.stat().st_size)
    rows = [line for line in decoded(path).splitlines() if line.strip() and line.lstrip()[0] not in "#%"]
    separator = max("\t;,|", key=rows[0].count)
    decimal = "," if separator != "," and re.search(r"\d,\d", rows[1]) else "."
    header = [cell.strip() for cell in rows[0].split(separator)]
    time = next((name for name in header if _TIME.search(name)), header[0])
    cell = rows[1].split(separator)[header.index(time)]
    lines = [("file", _name(folder, path), "the robot's log"), ("separator", separator, "between cells")]
    lines += [("decimal", decimal, "decimal mark"), ("time", time, "column of the robot's times")]
    quaternion = [next((n for n in header if re.search(rf"(?i)q_?{axis}$", n)), "") for axis in "xyzw"]
    groups: dict[str, dict[str, str]] = {}
    for name in header:
        if (match := _AXIS.match(name)) and name not in [*quaternion, time]:
            groups.setdefault(match[1], {})[match[2].lower()] = name
    whole = {prefix: tuple(axes[axis] for axis in "xyz") for prefix, axes in groups.items() if set(axes) == set("xyz")}
    if not whole:
        raise ValueError(f"{path}: no three columns end in x, y and z; it has {header}. Write the mapping by hand.")
    unit = "iso" if ":" in cell else match[1].lower() if (match := _UNIT.search(time)) else ""
    unit = {"sec": "s", "nsec": "ns"}.get(unit, unit)
    table = Table(file=path.name, separator=separator, decimal=decimal, time=time, time_unit=unit or "s")
    stamps, columns = read_columns(path, table, [name for group in whole.values() for name in group])
    if not unit:
        step = float(np.median(np.abs(np.diff([float(t - stamps[0]) for t in stamps]))))
        scales = {"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
        unit = next((name for name, scale in scales.items() if _STEP_S[0] <= step * scale <= _STEP_S[1]), "s")
    lines += [("time_unit", unit, "s, ms, us, ns, or iso for dates")]
    x = {prefix: np.stack([columns[name] for name in group], axis=-1) for prefix, group in whole.items()}
    one, *more = x.values()
    reach = np.nanmedian(np.linalg.norm(more[0] - one, axis=1)) if more else np.nanmax(np.nanstd(one, axis=0))
    told = next((m[3].lower() for group in whole.values() if (m := _AXIS.match(group[0])) and m[3]), "")
    scales_mm = {"mm": 1, "m": 1e3, "um": 1e-3}
    fits = [name for name, scale in scales_mm.items() if _REACH_MM[0] <= reach * scale <= _REACH_MM[1]]
    lines += [("length_unit", told or (fits or ["mm"])[0], "m, mm or um" + ("" if told or fits else "; CHECK"))]
    offset = ("offset_s", "estimate", "t_robot = t_video + offset_s: seconds, or estimate to find it")
    if all(quaternion) or len(whole) == 1:
        prefix = min(whole, key=lambda prefix: "pos" not in prefix.lower())
        pose = {"position": whole[prefix], "rotation": tuple(quaternion), "rotation_kind": "quaternion_xyzw"}
        if jaw := next((name for name in header if re.search(r"(?i)grip|jaw|open", name)), ""):
            pose |= {"gripper": jaw, "gripper_unit": next((u for u in ("deg", "mm") if u in jaw.lower()), "rad")}
        lines += [("pose", pose, "CHECK: columns of the tool's pose, and of the full angle between its jaws"), offset]
        lines += [("[tool]", None, ""), ("estimate", True, "from labels; or give landmarks_mm, pivot_s, hinge")]
        return lines, LANDMARKS
    names, matched = _matched(list(whole))
    return [*lines, ("landmarks", {n: whole[matched[n]] for n in names}, "CHECK: columns of each landmark"), offset], names


def _matched(theirs: list[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Our names, and theirs for each: alike but for case and signs, else in their order."""

    def bare(name: str) -> str:
        return re.sub(r"[^a-z0-9]", "", name.lower())

    if len(theirs) != len(LANDMARKS):
        names = tuple(re.sub(r"\W", "_", name).strip("_ ") or f"point_{k}" for k, name in enumerate(theirs, 1))
        names = tuple(name if name[0].isalpha() else f"point_{name}" for name in names)
        return names, dict(zip(names, theirs, strict=True))
    found = {name: next((t for t in theirs if bare(name) in bare(t)), None) for name in LANDMARKS}
    rest = [t for t in theirs if t not in found.values()]
    return LANDMARKS, {name: t or rest.pop(0) for name, t in found.items()}


def _bag(folder: Path, path: Path) -> tuple[list[tuple], tuple[str, ...]]:
    from rosbags.highlevel import AnyReader

    where = path.parent if path.suffix in (".db3", ".mcap") else path
    with AnyReader([where]) as reader:
        topics = {c.topic: c.msgtype.split("/")[-1] for c in reader.connections}
    kinds = {topic: _TOPICS[kind] for topic, kind in topics.items() if kind in _TOPICS}
    pointed = [topic for topic, kind in kinds.items() if kind == "point"]
    if not kinds:
        raise ValueError(f"{path}: no topic of type {', '.join(_TOPICS)}; it has {topics}. Write the mapping by hand.")
    lines = [("file", _name(folder, path), "the robot's log")]
    if len(pointed) > 1:
        names, matched = _matched(pointed)
        columns = {n: tuple(f"{matched[n]}:point.{axis}" for axis in "xyz") for n in names}
        lines += [("time", f"{pointed[0]}:header.stamp", "a topic, and its field of times; or :received")]
        rest, more = [("landmarks", columns, "CHECK: fields of each landmark")], names
    else:
        topic = next(topic for topic, kind in kinds.items() if kind != "point" or len(kinds) == 1)
        position, rotation = ("translation", "rotation") if kinds[topic] == "transform" else ("position", "orientation")
        field = f"{topic}:{kinds[topic]}"
        pose = {"position": tuple(f"{field}.{position}.{axis}" for axis in "xyz")}
        pose |= {"rotation": tuple(f"{field}.{rotation}.{axis}" for axis in "xyzw"), "rotation_kind": "quaternion_xyzw"}
        lines += [("time", f"{topic}:header.stamp", "a topic, and its field of times; or :received")]
        rest, more = [("pose", pose, "CHECK: fields of the tool's pose; gripper = ... its opening")], LANDMARKS
    lines += [("length_unit", "m", "m, mm or um; ROS counts in m"), *rest, ("offset_s", "estimate", "or a number of seconds")]
    if len(pointed) < 2:
        lines += [("[tool]", None, ""), ("estimate", True, "from labels; or give landmarks_mm, pivot_s, hinge")]
    return lines, more


def _is_label(path: Path) -> bool:
    return path.suffix.lower() in (".json", ".zip", ".xml", ".slp", ".h5") or path.name.startswith("CollectedData")


def _labels(folder: Path, paths: list[Path]) -> list[tuple]:
    for path in filter(_is_label, paths):
        kinds = {".slp": ["sleap"], ".h5": ["deeplabcut"], ".csv": ["deeplabcut"], ".json": ["coco", "label_studio"]}
        for kind in kinds.get(path.suffix.lower(), ["cvat"]):
            try:
                found = list(dict.fromkeys(label.name for label in READERS[kind](path)))
            except (ValueError, OSError):
                continue
            if not found:
                continue
            names, matched = _matched(found)
            drawn = kind in ("cvat", "label_studio")
            lines = [("kind", kind, "coco, cvat, label_studio, deeplabcut or sleap")]
            lines += [("file", _name(folder, path), "both cameras")]
            lines += [("names", {n: matched[n] for n in names}, "CHECK: their name of each landmark")]
            comment = "what (0, 0) is in the top left pixel: its centre, or its corner as CVAT and Label Studio draw"
            lines += [("pixel_origin", "corner" if drawn else "centre", comment)]
            return [*lines, ("first_frame", 0, "number of the first frame in the labels' image names")]
    return []
