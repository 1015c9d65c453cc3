"""Reads tables of other programs (CSV, JSON, ROS bags) with exact times, and the robot's log in mm and s."""

import json
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lib.importing.mapping import Mapping, Pose, Table
from lib.recordings import Kinematics
from lib.recordings.tables import decoded, number, rows_of

_SECONDS = {"s": Decimal(1), "ms": Decimal("1e-3"), "us": Decimal("1e-6"), "ns": Decimal("1e-9")}
_MILLIMETRES = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3}
_STEP_S = 2e-5, 3.0  # plausible median step of a robot's samples; outside this range the unit of time must be wrong
_ROUNDED = 0.25  # share of the rows that repeat the time before, from which on they count as rounded
_DAY_S = 86400
_EMPTY = {"nan", "NaN", "NAN", "null", "None", "NA"}
JSON = ".json", ".jsonl", ".ndjson"
_STAMPS = {"sec", "secs"}, {"nsec", "nsecs", "nanosec", "nanosecs"}  # keys of a time stamp of ROS
_FAR = 10.0  # a value that recurs in all coordinates is no position if it is farther off than so many ranges of the others


def exact_seconds(text: str, unit: str, where: str) -> Decimal:
    """A time as exact seconds.  "iso" dates without a zone count as UTC; "hms" times of day count from midnight.

    >>> exact_seconds("1700000000123456789", "ns", "log.csv"), exact_seconds("1970-01-01T00:00:01.5", "iso", "log.csv")
    (Decimal('1700000000.123456789'), Decimal('1.500000'))
    >>> exact_seconds("9:29:59.28", "hms", "log.csv")
    Decimal('34199.280000')
    """
    with suppress(ValueError, InvalidOperation):
        if unit in ("iso", "hms"):
            day = "" if unit == "iso" else "1970-01-01T0" if text.strip()[1:2] == ":" else "1970-01-01T"
            date = datetime.fromisoformat(day + text.strip())
            date = date if date.tzinfo else date.replace(tzinfo=UTC)
            return Decimal((date - datetime.fromtimestamp(0, UTC)) // timedelta(microseconds=1)).scaleb(-6)
        value = Decimal(text.strip()) * _SECONDS[unit]
        if value.is_finite():
            return value
    raise ValueError(f"{where}: {text.strip()!r} is not a time in {unit}. Check time, time_unit and decimal.")


def since(time: Iterable[Decimal], zero: Decimal) -> np.ndarray:
    """Exact times as float64 seconds after `zero`."""
    return np.array([float(t - zero) for t in time])


def increasing(time: list[Decimal], where: str, usual_s: tuple[float, float], unit: str, places: Sequence[str] = ()) -> None:
    """Raise a ValueError if the times of rows or frames repeat or go back, or if their median step makes `unit` doubtful."""
    for i, (before, now) in enumerate(pairwise(time), start=1):
        if now <= before:
            told = [f"{t:.9f}".rstrip("0").rstrip(".") + " s" for t in (before, now)]
            what = f"the time {'repeats' if now == before else 'goes back'} ({', then '.join(told)})"
            cure = "Sort the rows and drop the repeated ones, or name another column of times"
            steps = [later - earlier for earlier, later in pairwise(time)]
            rising = [step for step in steps if step > 0]
            if min(steps) == 0 and 0 < len(rising) < (1 - _ROUNDED) * len(steps):
                cure = f"Times seem to be rounded to {min(rising)} s. Export them with more digits; or if the rate is known "
                cure += "and steady, spread equal times evenly over that step"
            raise ValueError(f"{places[i] if places else f'{where}, entry {i + 1}'}: {what}. {cure}.")
    step = float(np.median(np.diff(since(time, time[0])))) if len(time) > 1 else 1.0
    if not usual_s[0] <= step <= usual_s[1]:
        what = f"entries are {step:.3g} s apart, {usual_s[0]} to {usual_s[1]} s is plausible"
        raise ValueError(f"{where}: {what}. Check {unit}.")


def uncommented(text: str, separator: str = "") -> list[str]:
    """The lines of a table, with comments and a row of units below the header replaced by blanks.

    The last comment before the rows is the header if it has as many cells, no number among them, and the first row starts
    with a number: so `numpy.savetxt` and `rostopic echo -p` write.  If no separator is given, that of the first row is found.

    >>> uncommented("# made by a robot\\n# t,x\\n0.1,2\\n"), uncommented("t,x\\ns,mm\\n0.1,2\\n")
    (['', 't,x', '0.1,2'], ['t,x', '', '0.1,2'])
    """
    lines = text.splitlines()
    bare = ["" if line.lstrip()[:1] in ("#", "%") else line for line in lines]
    first = next((i for i, line in enumerate(bare) if line.strip()), 0)
    if header := next((line for line in reversed(lines[:first]) if line.strip()), "").lstrip(" \t#%"):
        names, cells = (line.split(separator or separator_of(bare[first])) for line in (header, bare[first]))
        row = re.match(r'[\s"]*[-+]?\.?\d', cells[0])
        numbers = [name for name in names if re.fullmatch(r'[\s"]*[-+]?\.?\d[-+\d.eE]*[\s"]*', name)]
        if row and len(names) == len(cells) and not numbers:
            bare[first - 1] = header
    filled = [i for i, line in enumerate(bare) if line.strip()][:2]
    if len(filled) == 2:
        head, below = (bare[i].split(separator or separator_of(bare[filled[0]])) for i in filled)
        words = [cell for cell in below if re.search(r"[^\W\d_]", cell) and not re.fullmatch(r"(?i)\W*(nan|inf)\W*", cell)]
        if len(head) == len(below) and words and not any(re.search(r"^\W*\d", cell) for cell in below):
            bare[filled[1]] = ""
    return bare


def separator_of(line: str) -> str:
    """The separator of a line: whichever of tab, semicolon, comma and bar is the most frequent; without them, any space."""
    return " " if " " in line and not re.search(r"[\t;,|]", line) else max("\t;,|", key=line.count)


def text_of(path: Path) -> tuple[str, bool]:
    """The text of a file in UTF-8, UTF-16 with a byte order mark, or else Windows-1252; and True if it is the last one."""
    try:
        return decoded(path, utf_16=True), False
    except ValueError as refused:
        with suppress(UnicodeDecodeError):
            return path.read_bytes().decode("cp1252"), True
        raise refused from None


def json_rows(path: Path, notes: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield place and cells of header and rows of JSON: one object a line, or one list of objects.

    Columns are named by their path, such as "pose.position.x" or "joints[0]"; a time stamp of ROS is one column.  `notes`
    gets a sentence about a last line that is cut, which is left out.
    """
    text, places, entries = decoded(path, utf_16=True), [f"{path}"], []
    parse = partial(json.loads, parse_float=str, parse_int=str)  # keeps all digits of a time
    listed = text.lstrip()[:1] == "["
    parts = [text] if listed else text.rstrip().split("\n")
    for n, part in enumerate(parts, start=1):
        try:
            found = parse(part) if part.strip() else []
        except (ValueError, RecursionError) as error:
            if n > 2 and n == len(parts) and text[-1] != "\n":
                notes.append(f"The last line of {path.name} is cut and was left out.")
                break
            where = f"{path}, line {n}: not JSON ({error})"
            raise ValueError(f"{where}. Write one object a line, one for each time, or one list of them.") from None
        found = found if isinstance(found, list) else [found]
        entries += found
        places += [f"{path}, {f'entry {k}' if listed else f'line {n}'}" for k in range(1, len(found) + 1)]
    if len(entries) < 2 or not all(isinstance(entry, dict) for entry in entries):
        what = "JSON needs one object a line, one for each time, or one list of them"
        raise ValueError(f"{path}: {what}. Write it so, or as CSV.")
    rows = [dict(_leaves(entry.items())) for entry in entries]
    header = list(dict.fromkeys(name for row in rows for name in row))
    yield from zip(places, [header, *([row.get(name, "") for name in header] for row in rows)], strict=True)


def _leaves(items: Iterable[tuple[str, object]]) -> Iterator[tuple[str, str]]:
    """Path and text of each value inside an object."""
    for name, value in items:
        keys = sorted(value, reverse=True) if isinstance(value, dict) else []  # "secs" goes before "nsecs"
        if len(keys) == 2 and all(key in kind for key, kind in zip(keys, _STAMPS, strict=True)):
            yield name, f"{value[keys[0]]}.{value[keys[1]]!s:>09}"
        elif isinstance(value, dict):
            yield from _leaves((f"{name}.{key}", inner) for key, inner in value.items())
        elif isinstance(value, list):
            yield from _leaves((f"{name}[{i}]", inner) for i, inner in enumerate(value))
        else:
            yield name, "" if value is None else str(value)


def read_columns(
    path: Path, table: Table, names: Iterable[str], notes: list[str]
) -> tuple[list[Decimal], dict[str, np.ndarray], list[str]]:
    """Read exact times, the named columns (m,) with NaN for empty cells, and each row's place; from CSV, JSON or a ROS bag.

    `notes` gets a sentence about another encoding than UTF-8, and about a last line that is cut, which is left out.
    """
    if path.suffix in (".bag", ".db3", ".mcap") or path.is_dir():
        return _read_bag(path, table, list(names))
    if path.suffix.lower() in (".npy", ".npz", ".mat", ".h5", ".parquet", ".xls", ".xlsx"):
        what = "only CSV tables, JSON with one object a line and ROS bags are read here"
        raise ValueError(f"{path}: {what}. Convert it to CSV, one row for each time.")
    wanted = [table.time, *names]
    rows = json_rows(path, notes) if path.suffix.lower() in JSON else _csv_rows(path, table.separator, notes)
    place, header = next(rows, (str(path), []))
    for name in wanted:
        if header.count(name) != 1:
            what = "two columns are" if name in header else "no column is"
            cure = f"Check the names and separator = {table.separator!r}"
            raise ValueError(f"{place}: {what} called {name!r}; it has {header}. {cure}.")
    at = [header.index(name) for name in wanted]
    time, values, places = [], [], []
    for place, cells in rows:
        places.append(place)
        cells = [cells[i].replace(table.decimal, ".") for i in at]
        time.append(exact_seconds(cells[0], table.time_unit, f"{place}, column {table.time}"))
        named = zip(cells[1:], wanted[1:], strict=True)
        values.append([number("" if cell in _EMPTY else cell, place, name) for cell, name in named])
    if not time:
        raise ValueError(f"{path}: the table has no row. Export it again.")
    if table.time_unit == "hms":  # it begins anew at midnight
        days = accumulate((now < before - _DAY_S // 2 for before, now in pairwise(time)), initial=0)
        time = [t + _DAY_S * day for t, day in zip(time, days, strict=True)]
    return time, dict(zip(wanted[1:], np.array(values, np.float64).reshape(len(time), -1).T, strict=True)), places


def _csv_rows(path: Path, separator: str, notes: list[str]) -> Iterator[tuple[str, list[str]]]:
    text, by_excel = text_of(path)
    notes += [f"{path.name} is not UTF-8 and was read as Windows-1252."] * by_excel
    lines = uncommented(text, separator)
    cells = [line.count(separator) + 1 for line in lines if line.strip()]
    if text[-1:] not in "\r\n" and lines[-1].strip() and cells[-1] < min(cells[0], cells[-2:][0]):
        notes.append(f"The last line of {path.name} is cut ({cells[-1]} of {cells[0]} cells) and was left out.")
        lines.pop()
    return rows_of(path, "\n".join(lines), separator)


@contextmanager
def _bag(path: Path) -> Iterator:
    """The reader of a ROS 1 or 2 bag.  A file that is no bag raises a ValueError, whatever the reader raised."""
    from rosbags.highlevel import AnyReader, AnyReaderError  # here, since it takes half a second and few need it
    from rosbags.typesys import Stores, get_typestore

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except (AnyReaderError, OSError, KeyError, AttributeError, AssertionError) as error:
        raise ValueError(f"{path}: the bag cannot be read ({error}). Record or convert it again.") from None


def topics_of(path: Path) -> dict[str, str]:
    """The topics of a ROS 1 or 2 bag, each with its message type, such as PoseStamped."""
    with _bag(path) as reader:
        return {c.topic: c.msgtype.split("/")[-1] for c in reader.connections}


def _read_bag(path: Path, table: Table, names: list[str]) -> tuple[list[Decimal], dict[str, np.ndarray], list[str]]:
    """Read columns of a bag.  Columns of other topics are interpolated at the times of the topic that `table.time` names."""
    places = {name: name.partition(":")[::2] for name in (table.time, *names)}  # topic and field
    found: dict[str, list] = {name: [] for name in places}
    stamps: dict[str, list[Decimal]] = {topic: [] for topic, _ in places.values()}
    on_arrival = places[table.time][1] == "received"  # robot and recorder may have different clocks
    with _bag(path) as reader:
        if missing := sorted(set(stamps) - (there := {c.topic for c in reader.connections})):
            raise ValueError(f"{path}: no topic is called {missing[0]!r}; it has {', '.join(sorted(there))}.")
        for c, received_ns, raw in reader.messages([c for c in reader.connections if c.topic in stamps]):
            message, received = reader.deserialize(raw, c.msgtype), Decimal(received_ns).scaleb(-9)
            header = None if on_arrival else getattr(message, "header", None)
            stamps[c.topic].append(received if header is None else _field(header, "stamp", str(path)))
            for name, (topic, field) in places.items():
                if topic == c.topic:
                    found[name].append(received if field == "received" else _field(message, field, f"{path}: {name}"))
    time = found[table.time]
    if not time or not isinstance(time[0], Decimal):
        raise ValueError(f"{path}: {table.time!r} is not a time; name /topic:header.stamp or /topic:received.")
    columns = {name: np.array(found[name], np.float64) for name in names}
    for name, (topic, _) in places.items():
        if topic != places[table.time][0]:
            at, known = since(time, time[0]), since(stamps[topic], time[0])
            columns[name] = Kinematics(known, np.tile(columns[name][:, None, None], 3)).at(at)[:, 0, 0]  # NaN in a gap
    return time, columns, [f"{path}, message {i}" for i in range(1, len(time) + 1)]


def _field(message: object, field: str, where: str) -> float | Decimal:
    """A number or a time stamp in a message, such as "pose.position.x", "position[0]" or "header.stamp"."""
    for part in field.split("."):
        name, _, index = part.rstrip("]").partition("[")
        try:
            message = getattr(message, name)
            message = message[int(index)] if index else message
        except (AttributeError, IndexError, ValueError):
            there = [key for key in getattr(message, "__dict__", {}) if not key.startswith("__")]
            raise ValueError(f"{where}: the message has no {part!r}; it has {there}.") from None
    if hasattr(message, "nanosec"):
        return Decimal(message.sec) + Decimal(message.nanosec).scaleb(-9)
    try:
        return float(message)
    except TypeError:
        raise ValueError(f"{where}: this field is not a number; name a number inside it.") from None


def read_robot(
    folder: Path, mapping: Mapping, notes: list[str]
) -> tuple[list[Decimal], np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Read the robot's log, in the robot frame that the mapping asks for.

    Returns exact times (m,) and the landmarks (m, k, 3) mm, None, None.  If the log has poses of the tool instead: times,
    positions (m, 1, 3) mm, rotations (m, 3, 3), and the full angle (m,) rad between the jaws, or None if it is not logged.
    `notes` gets a sentence about each thing that was not read as it stands, such as rows that were left out.
    """
    robot, pose = mapping.robot, mapping.robot.pose
    path = folder / robot.file
    groups = [robot.landmarks[name] for name in mapping.landmarks] if pose is None else [pose.position]
    names = [name for group in groups for name in group]
    names += [] if pose is None else [*pose.rotation, *([pose.gripper] if pose.gripper else [])]
    time, columns, places = read_columns(path, robot, dict.fromkeys(names), notes)
    rows = list(zip(time, *(np.nan_to_num(values, nan=np.inf) for values in columns.values()), strict=True))
    new = [i for i, row in enumerate(rows) if not i or row != rows[i - 1]]
    if len(new) < len(rows):
        notes.append(f"{path.name}: {len(rows) - len(new)} rows that repeat the row before were left out.")
        time, places, columns = [time[i] for i in new], [places[i] for i in new], {n: x[new] for n, x in columns.items()}
    increasing(time, str(path), _STEP_S, "time_unit", places)
    _blank_sentinels(columns, groups, notes)
    if empty := [name for name in names if np.isnan(columns[name]).all()]:
        raise ValueError(f"{path}: no row has a value in {', '.join(empty)}. Name other columns, or fewer landmarks.")
    x = np.stack([np.stack([columns[name] for name in group], axis=-1) for group in groups], axis=1)
    x = x * _MILLIMETRES[robot.length_unit]
    x[np.isnan(x).any(axis=2)] = np.nan
    turn = np.array(robot.frame.rotation)
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-4 or np.linalg.det(turn) < 0:
        raise ValueError("robot.frame.rotation: not a rotation; its rows must be orthonormal and right-handed.")
    x = x @ turn.T + robot.frame.translation_mm
    spread_mm = float(np.linalg.norm(np.diff(np.nanpercentile(x, [5, 95], axis=0), axis=0), axis=2).max())
    if not 0.05 <= spread_mm <= 2000:
        what = f"with length_unit = {robot.length_unit!r} the tool moves over {spread_mm:.3g} mm"
        raise ValueError(f"{path}: {what}; 0.05 to 2000 mm is plausible. Check length_unit: m, cm, mm or um.")
    if pose is None:
        return time, x, None, None
    if pose.rotation_kind == "euler_xyz_deg":
        cure = 'convert them to degrees; or, if they are a rotation vector, set rotation_kind = "rotation_vector_rad"'
        _doubt_degrees(path, pose.rotation, np.stack([columns[name] for name in pose.rotation]), 2 * np.pi, cure)
    R = turn @ _rotations(places, pose, np.stack([columns[name] for name in pose.rotation], axis=-1), notes)
    return time, x, R, _opening(path, mapping, columns[pose.gripper]) if pose.gripper else None


def _blank_sentinels(columns: dict[str, np.ndarray], groups: Sequence[Sequence[str]], notes: list[str]) -> None:
    """Blank, in `columns`, numbers that stand for "no report": they recur in all three coordinates of a position at once.

    Such a number is far from all other positions, or it is 0 and they move by less than their distance from 0.
    """
    beside = columns.keys() - {name for group in groups for name in group}  # the rotation and the gripper of a pose
    table = np.stack([columns[name] for group in groups for name in group], axis=-1)
    if len(groups) > 1 and (same := (table == table[:, :1]).all(axis=1)).any():  # landmarks cannot coincide
        for name in (name for group in groups for name in group):
            columns[name][same] = np.nan
        notes.append(f"{same.sum()} rows with one number in all coordinates of all landmarks were taken for no report.")
    for group in groups:
        x = np.stack([columns[name] for name in group], axis=-1)
        alike = (x == x[:, :1]).all(axis=1)  # NaN is not equal
        others = x[~alike & np.isfinite(x).all(axis=1)]
        for value in np.unique(x[alike, 0]) if len(others) else ():
            rows = alike & (x[:, 0] == value)
            distance = float(np.linalg.norm(others - value, axis=1).min())
            if rows.sum() > 1 and distance > (_FAR if value else 1.0) * np.ptp(others, axis=0).max() > 0:
                for name in (*group, *(beside if value else ())):
                    columns[name][rows & (columns[name] == value)] = np.nan
                notes.append(f"{value:g} in {', '.join(group)} was taken for no report, in {rows.sum()} rows.")


def _opening(path: Path, mapping: Mapping, opening: np.ndarray) -> np.ndarray:
    unit, length_mm = mapping.robot.pose.gripper_unit, mapping.tool.jaw_length_mm
    if unit == "mm":
        if length_mm is None or np.nanmax(np.abs(opening)) > 2 * length_mm:
            raise ValueError(f"{path}: a gripper in mm needs tool.jaw_length_mm, at least half the widest opening.")
        return 2 * np.arcsin(opening / (2 * length_mm))
    if unit == "deg":
        _doubt_degrees(path, [mapping.robot.pose.gripper], opening, 2.0, 'set gripper_unit = "rad"')
        opening = np.deg2rad(opening)
    if np.nanmax(np.abs(opening)) > np.pi:
        raise ValueError(f"{path}: the gripper opens to {np.nanmax(np.abs(opening)):.3g} rad. Check gripper_unit.")
    return opening


def _doubt_degrees(path: Path, names: Sequence[str], angles: np.ndarray, most: float, cure: str) -> None:
    """Warn that angles which the mapping states in degrees may be radians: they vary, but none exceeds `most`."""
    largest = np.nanmax(np.abs(angles))
    if largest <= most and np.ptp(angles[np.isfinite(angles)]) > 0.05:
        what = f"the angles in {', '.join(names)} are {largest:.3g} degrees at most"
        warnings.warn(f"{path}: {what}. Are they radians? Then {cure}.", stacklevel=2)


def _rotations(places: list[str], pose: Pose, values: np.ndarray, notes: list[str]) -> np.ndarray:
    """Rotations (m, 3, 3) from the columns (m, c) of a pose, NaN where a cell is empty or all of a quaternion is 0.

    Quaternions of one length that is not 1 are normalised, which adds a sentence to `notes`.
    """
    kind, quaternion = pose.rotation_kind, pose.rotation_kind.startswith("quaternion")
    known = np.isfinite(values).all(axis=1) & (values.any(axis=1) | (not quaternion))
    v, R, why = values[known], np.full((len(values), 3, 3), np.nan), ""
    if kind == "matrix":
        v = v.reshape(-1, 3, 3)
        valid = (np.abs(v @ v.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) < 1e-2) & (np.linalg.det(v) > 0)
        made = Rotation.from_matrix
    elif quaternion:
        length = np.linalg.norm(v, axis=1)
        usual = float(np.median(length)) if len(v) else 1.0
        valid = (usual > 1e-3) & ((np.abs(length / usual - 1) < 1e-2) | (np.abs(length - 1) < 1e-2))
        if abs(usual - 1) > 1e-2:
            notes.append(f"The quaternions in {', '.join(pose.rotation)} have the length {usual:.4g}; they were normalised.")
        if not valid.all():
            why = f" (lengths vary from {length.min():.4g} to {length.max():.4g}; if the columns are right, normalise them)"
        made = partial(Rotation.from_quat, scalar_first=kind == "quaternion_wxyz")
    else:
        degrees = kind == "euler_xyz_deg"
        valid = np.abs(v).max(axis=1) <= (360 if degrees else 2 * np.pi)
        made = partial(Rotation.from_euler, "xyz", degrees=True) if degrees else Rotation.from_rotvec
    if not valid.all():
        row = np.flatnonzero(known)[valid.argmin()]
        what = f"columns {', '.join(pose.rotation)} are no {kind}: {', '.join(f'{value:.6g}' for value in values[row])}{why}"
        raise ValueError(f"{places[row]}: {what}. Check rotation_kind and rotation; leave the cells of an unknown one empty.")
    R[known] = made(v).as_matrix()
    return R
