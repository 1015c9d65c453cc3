"""Guesses a first mapping from the files of a folder.  Each line has a comment; CHECK marks what only a person can know.

Where a column's name states no unit, the guess is the unit in which the log's time steps and motion are plausible.
"""

import csv
import re
from collections import Counter
from contextlib import suppress
from itertools import product
from pathlib import Path

import av
import cv2
import numpy as np

from lib.correspondences import LANDMARKS
from lib.files import toml
from lib.importing.labels import labels_of
from lib.importing.logs import JSON, json_rows, separator_of, text_of, topics_of, uncommented
from lib.importing.video import IMAGES, VIDEOS, decimals, last_number, quarters, stated
from lib.recordings.tables import read_toml

_TALL, _WIDE = 1.1, 1.95  # width over height of a film with both views: below, on top of each other; above, side by side
_LOG_STEP_S = 0.4  # longest step of a robot's log in s; steps of a log in ms are longer, up to 2.5 kHz
_TIME = re.compile(r"(?i)^(t|sec|secs|s|ms|us|ns)$|time|stamp|zeit|temps|tiempo|tempo|tijd|^t[_ \[(]")
_AXIS = re.compile(r"(?i)^(.*?)[ _.\-]?([xyz])[ _]?[\[(]?(mm|cm|um|m)?[\])]?$")
_LISTED = re.compile(r"^(.*)\[([012])\]$")  # of a list of three in JSON
_ROTATION = re.compile(r"(?i)(^|[ _.\-])r$")  # of rx, ry, rz
_NO_POINT = re.compile(r"(?i)(^|[ _.\-])([vwf]|vel\w*|speed|acc\w*|force|torque)$")  # of vx, vy, vz and the like
_UNIT = re.compile(r"(?i)(?:^|[ _\[(])(ns|us|ms|s)[\])]?$")
_NUMBERED = re.compile(r"^(.*?)[ _.\[(]*\d[ _.,\[\]()]*\d?[\])]?$")
_CURE = "Convert the robot's log to CSV: one row for each time, and three columns for each landmark"
_TABLES = ".csv", ".tsv", ".txt", *JSON
_LABELS = {".slp": ["sleap"], ".csv": ["deeplabcut"], ".json": ["coco", "label_studio"], ".zip": ["cvat"], ".xml": ["cvat"]}


def guess_mapping(source: str | Path) -> str:
    """The text of a mapping file for the files in a folder, which must hold a video or images, and a robot's log."""
    folder = Path(source)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; SOURCE is the folder with your files.")
    paths = {p.relative_to(folder).as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file() and p.name[0] != "."}
    deeplabcut = {n: p for n, p in paths.items() if p.stem.startswith("CollectedData")}
    labels = _labels({n: p for n, p in paths.items() if p.suffix in set(_LABELS) - {".csv"}} | deeplabcut)
    tables, refused = {}, None
    for name in (n for n, p in paths.items() if p.suffix.lower() in _TABLES and n not in {*deeplabcut, labels.get("file")}):
        try:
            tables[name] = _table(paths[name])
        except (ValueError, csv.Error) as error:  # it may be notes in another encoding
            refused = refused if name.lower().endswith(".json") else error  # which holds many other things
    robot = _robot(folder, paths, {name: table for name, table in tables.items() if _is_log(*table)}, refused)
    estimate = "pose" in robot and bool(labels)
    robot["offset_s"] = 0.0 if estimate else "estimate"
    hinge = {"point_mm": [0.0] * 3, "axis": [0.0, 1.0, 0.0], "jaw_mm": [0.0] * 3}  # zeros are refused until measured
    to_measure = {"landmarks_mm": {"base": [0.0] * 3}, "hinge": hinge} if "pose" in robot else {}
    guess = {"name": re.sub(r"[<>&]", "_", folder.resolve().name), "landmarks": list(robot.get("landmarks", LANDMARKS))}
    video = _video(folder, paths, {name: table for name, table in tables.items() if name != robot["file"]})
    guess |= {"robot_accuracy_mm": 0.01, "readout_s": 0.0, "video": video, "robot": robot}
    guess |= {"tool": {"estimate": True} if estimate else to_measure, "labels": labels}
    comments = read_toml(Path(__file__).with_name("comments.toml"))
    if "pose" in robot and "rotation" not in robot["pose"]:
        comments["robot.pose"] = comments["robot.rotation"]
    if "*" in video.get("file", ""):
        comments["video.file"] = comments["video.images"]
    text = "# What `python3 -m lib import` reads, guessed from the files.  Look at each line.\n"
    for key, value in guess.items():
        table = key in ("video", "robot", "tool", "labels")
        lines = {f"{key}.{inner}": entry for inner, entry in value.items()} if table else {key: value}
        text += f"\n[{key}]\n" if table and value else ""
        text += "".join(f"{k.split('.')[-1]} = {toml(v)}  # {comments[k]}\n" for k, v in lines.items())
    return text


def _video(folder: Path, paths: dict[str, Path], tables: dict[str, tuple]) -> dict:
    films, images = ([n for n, path in paths.items() if path.suffix.lower() in kind] for kind in (VIDEOS, IMAGES))
    if len(films) == 1:
        return _layout(folder / films[0]) | {"file": films[0], **_film_times(folder / films[0], tables), "exchanged": False}
    kinds = Counter((Path(name).parent / f"*{Path(name).suffix}").as_posix() for name in images)
    names = films or [pattern for pattern, _ in kinds.most_common(2)]
    if not names:
        raise FileNotFoundError(f"{folder}: no video ({', '.join(VIDEOS)}) and no image files in it.")
    names = names if len(names) > 1 else _sides(folder, names[0])
    left, *rights = sorted(names, key=lambda name: ("right" in name.lower(), name))
    digits = len(str(max((last_number(name) or 0 for name in images), default=0)))
    times = _film_times(folder / left, tables) if films else {}
    seconds = [] if films else decimals(list(folder.glob(left)))
    if seconds and (int(min(seconds)) < int(max(seconds)) or max(seconds) >= 10**9):  # else numbers: cam_1.0001 is frame 1
        times = {"times": "names", "name_unit": "s"}
    elif not films and digits >= 10:
        times = {"times": "names", "name_unit": {10: "s", 13: "ms", 16: "us"}.get(digits, "ns")}
    elif not films:
        times = _frame_times(tables, len(list(folder.glob(left)))) or {"times": "fps", "fps": 25.0}
    views = {"layout": "two", "left": left, "right": rights[0]} if rights else {"layout": "side_by_side", "file": left}
    return {**views, **times, "exchanged": False}


def _layout(film: Path) -> dict:
    """How a film holds both views.  One that has the shape of a single view holds squeezed halves; these look alike."""
    with av.open(str(film)) as container:
        stream = container.streams.video[0]
        first = next(container.decode(stream), None)
        shape, keys = (stream.width, stream.height)[:: -1 if quarters(first) % 2 else 1], stated(stream, first)
    layout = "top_bottom" if shape[0] < _TALL * shape[1] else "side_by_side"
    if first and shape[0] * keys.get("pixel_aspect", 1) < _WIDE * shape[1] and layout == "side_by_side":
        small = cv2.resize(np.rot90(first.to_ndarray(format="gray"), quarters(first)), (64, 64), interpolation=cv2.INTER_AREA)
        with np.errstate(invalid="ignore"):  # of a black frame
            alike = [np.corrcoef(*(half.ravel() for half in np.split(small, 2, axis=axis)))[0, 1] for axis in (0, 1)]
        layout, keys["pixel_aspect"] = ("top_bottom", 0.5) if alike[0] > alike[1] else ("side_by_side", 2.0)
    return {"layout": layout, **keys}


def _film_times(film: Path, tables: dict[str, tuple]) -> dict:
    with av.open(str(film)) as container:
        return _frame_times(tables, container.streams.video[0].frames) or {"times": "container"}


def _sides(folder: Path, pattern: str) -> list[str]:
    """Patterns for the left and the right of a folder's images, if their names tell them apart, else the pattern of all."""
    every = set(folder.glob(pattern))
    sides = ("left", "right"), ("Left", "Right"), ("L", "R"), ("l", "r")
    for pair, form in product(sides, ("*{}", "{}*", "*_{}_*", "*{}*")):
        names = [pattern.replace("*", form.format(side)) for side in pair]
        left, right = (set(folder.glob(name)) for name in names)
        if left and right and left ^ right == every:
            return names
    return [pattern]


def _frame_times(tables: dict[str, tuple], frames: int) -> dict:
    """The table that has a time for each frame, if there is one."""
    for name, (dialect, columns) in tables.items():
        if any(len(cells) == frames and _TIME.search(column) for column, cells in columns.items()):
            return {"times": "table", "table": {"file": name, **dialect, **_time(columns, dialect["decimal"])}}
    return {}


def _table(path: Path) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Separator and decimal mark of a table, and the cells of each column."""
    if path.suffix.lower() in JSON:
        separator, (header, *rows) = ",", (cells for _, cells in json_rows(path, []))
    else:
        lines = [line for line in uncommented(text_of(path)[0]) if line.strip()] or [","]
        separator = separator_of(lines[0])
        if separator == " " and lines[0].count(" ") != lines[-1].count(" "):  # the name of a single column
            separator = ","
        header, *rows = ([cell.strip() for cell in cells] for cells in csv.reader(lines, delimiter=separator))
    decimal = "," if separator != "," and rows and re.search(r"\d,\d", separator.join(rows[0])) else "."
    columns = {name: [row[at] for row in rows if len(row) == len(header)] for at, name in enumerate(header)}
    return {"separator": separator, "decimal": decimal}, columns


def _is_log(dialect: dict[str, str], columns: dict[str, list[str]]) -> bool:
    """Whether a table has columns for times and three coordinates, which notes and other tables lack."""
    numeric = [np.isfinite(_numbers(cells, dialect["decimal"])).any() for cells in columns.values()]
    return len(numeric) > 3 and sum(numeric) >= 3


def _numbers(cells: list[str], decimal: str) -> np.ndarray:
    """The numbers in a sample of a column's cells; NaN for other text."""
    some = [cell.replace(decimal, ".") for cell in cells[:: max(1, len(cells) // 2000)]]
    return np.array([float(cell) if re.fullmatch(r"[-+\d.eE]+", cell) else np.nan for cell in some])


def _time(columns: dict[str, list[str]], decimal: str, longest_s: float = 3.0) -> dict[str, str]:
    """The column of the times and their unit, which its name states; else the one that makes steps `longest_s` at most."""
    time = next(filter(_TIME.search, columns), next(iter(columns)))
    if any(":" in cell for cell in columns[time][:1]):
        return {"time": time, "time_unit": "hms" if re.match(r"\d\d?:\d\d?:", columns[time][0]) else "iso"}
    if match := _UNIT.search(time):
        return {"time": time, "time_unit": match[1].lower()}
    step = np.nanmedian(np.diff(_numbers(columns[time][:100], decimal))) if len(columns[time]) > 1 else 0.0
    unit = next((unit for unit, per_s in (("s", 1), ("ms", 1e3), ("us", 1e6)) if step <= longest_s * per_s), "ns")
    return {"time": time, "time_unit": unit}


def _robot(folder: Path, paths: dict[str, Path], tables: dict[str, tuple], refused: Exception | None) -> dict:
    if bags := [name for name, path in paths.items() if path.suffix in (".bag", ".db3", ".mcap")]:
        return _bag(folder, bags[0].rpartition("/")[0] if (folder / bags[0]).with_name("metadata.yaml").exists() else bags[0])
    if not tables:
        others = [name for name, path in paths.items() if path.suffix.lower() not in (*VIDEOS, *IMAGES)]
        what = f"no log of a robot in it: no ROS bag, and no table ({', '.join(_TABLES)}) with three columns of numbers"
        raise refused or FileNotFoundError(f"{folder}: {what}. It has {', '.join(others) or 'no other files'}. {_CURE}.")
    name = max(tables, key=lambda name: paths[name].stat().st_size)
    dialect, columns = tables[name]
    time = _time(columns, dialect["decimal"], _LOG_STEP_S)
    cells = columns[time["time"]]
    if 2 * len(set(cells)) < len(cells):
        what = f"{len(cells)} rows have only {len(set(cells))} times in {time['time']!r}; pivot it if rows hold one landmark"
        what += ", or export the times with more digits"
        raise ValueError(f"{paths[name]}: {what}. {_CURE}.")
    turn = _rotation(columns, dialect["decimal"])
    groups: dict[str, dict[str, str]] = {}
    for column in columns:
        if (match := _AXIS.match(column)) and column not in (*turn.get("rotation", ()), time["time"]):
            groups.setdefault(match[1], {})[match[2].lower()] = column
        elif (match := _LISTED.match(column)) and f"{match[1]}[3]" not in columns:
            groups.setdefault(match[1], {})["xyz"[int(match[2])]] = column
    groups = {prefix: axes for prefix, axes in groups.items() if set(axes) == set("xyz") and not _NO_POINT.search(prefix)}
    points = {prefix: [axes[axis] for axis in "xyz"] for prefix, axes in groups.items()}
    if not turn and len(points) == 2 and (prefix := next(filter(_ROTATION.search, points), None)):
        angles = np.stack([_numbers(columns[name], dialect["decimal"]) for name in points[prefix]])
        kind = "rotation_vector_rad" if np.nanmax(np.abs(angles)) <= 2 * np.pi else "euler_xyz_deg"
        turn = {"rotation": points.pop(prefix), "rotation_kind": kind}
    if not points:
        raise refused or ValueError(f"{paths[name]}: none of {list(columns)} end in x, y and z. Write the mapping by hand.")
    length = next((match[3].lower() for point in points.values() if (match := _AXIS.match(point[0])) and match[3]), "")
    if not length:  # a tool moves by one millimetre to some centimetres
        axes = (_numbers(columns[column], dialect["decimal"]) for column in next(iter(points.values())))
        span = max(float(np.ptp(known)) if len(known := x[np.isfinite(x)]) else 1.0 for x in axes)
        length = "m" if span < 0.3 else "um" if span > 2000 else "mm"
    guess = {"file": name, **dialect, **time, "length_unit": length}
    if len(points) > 1 and not turn:
        return guess | {"landmarks": _matched(points)}
    pose = {"position": points[min(points, key=lambda prefix: "pos" not in prefix.lower())], **turn}
    if jaw := next((column for column in columns if re.search(r"(?i)grip|jaw|open", column)), ""):
        pose |= {"gripper": jaw, "gripper_unit": next((unit for unit in ("deg", "mm") if unit in jaw.lower()), "rad")}
    return guess | {"pose": pose}


def _rotation(columns: dict[str, list[str]], decimal: str) -> dict:
    """The columns of the tool's rotation and its kind: a quaternion by names, or numbered columns that hold a rotation."""
    fours = ([c[:-1] + axis for axis in axes] for c in columns for axes in ("xyzw", "XYZW") if c[-1:] == axes[3])
    if four := next((four for four in fours if set(four) <= columns.keys()), []):
        return {"rotation": four, "rotation_kind": "quaternion_xyzw"}
    numbered: dict[str, list[str]] = {}
    for column in sorted(columns):
        if match := _NUMBERED.match(column):
            numbered.setdefault(match[1], []).append(column)
    for names in numbered.values():
        if kind := {4: "quaternion_wxyz", 9: "matrix"}.get(len(names), ""):
            values = np.stack([_numbers(columns[name], decimal) for name in names], axis=-1)
            rows = values[np.isfinite(values).all(axis=1)].reshape(-1, *((1, 4) if len(names) == 4 else (3, 3)))
            if len(rows) and np.abs(rows @ rows.transpose(0, 2, 1) - np.eye(rows.shape[1])).max() < 1e-2:
                return {"rotation": names, "rotation_kind": kind}
    return {}


def _bag(folder: Path, name: str) -> dict:
    kinds = topics_of(folder / name)
    points, poses = ([topic for topic, kind in kinds.items() if kind == wanted] for wanted in ("PointStamped", "PoseStamped"))
    if not poses and len(points) < 2:
        raise ValueError(f"{folder / name}: no PoseStamped, no two PointStamped; it has {kinds}. Write the mapping by hand.")
    guess = {"file": name, "length_unit": "m", "time": f"{(points if len(points) > 1 else poses)[0]}:header.stamp"}
    if len(points) > 1:
        return guess | {"landmarks": _matched({topic: [f"{topic}:point.{axis}" for axis in "xyz"] for topic in points})}
    pose = {"position": [f"{poses[0]}:pose.position.{axis}" for axis in "xyz"]}
    pose |= {"rotation": [f"{poses[0]}:pose.orientation.{axis}" for axis in "xyzw"], "rotation_kind": "quaternion_xyzw"}
    return guess | {"pose": pose}


def _matched(theirs: dict[str, object]) -> dict[str, object]:
    """The entry for each of our landmarks: by name, apart from case and punctuation, else in their order."""
    bare = {name: re.sub(r"[^a-z0-9]", "", name.lower()) for name in (*theirs, *LANDMARKS)}
    if len(theirs) != len(LANDMARKS):
        return {f"point_{bare[name]}": value for name, value in theirs.items()}
    found = {name: next((t for t in theirs if bare[name] in bare[t]), None) for name in LANDMARKS}
    rest = [t for t in theirs if t not in found.values()]
    return {name: theirs[t or rest.pop(0)] for name, t in found.items()}


def _labels(paths: dict[str, Path]) -> dict:
    for file, path in paths.items():
        for kind in _LABELS.get(path.suffix, ()):
            with suppress(ValueError, OSError):
                if names := {label.name: label.name for label in labels_of(kind, path)}:
                    origin = "corner" if kind in ("cvat", "label_studio") else "centre"
                    return {"kind": kind, "file": file, "names": _matched(names), "pixel_origin": origin, "first_frame": 0}
    return {}
