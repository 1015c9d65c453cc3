"""Tables of other programs: CSV of any dialect and ROS bags, with exact times; and what a robot's log says in mm and s."""

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lib.importing.mapping import Mapping, Pose, Robot, Table

__all__ = ["RobotLog", "decoded", "exact_seconds", "increasing", "read_columns", "read_robot", "since"]

_SECONDS = {"s": Decimal(1), "ms": Decimal("1e-3"), "us": Decimal("1e-6"), "ns": Decimal("1e-9")}
_MILLIMETRES = {"m": 1e3, "mm": 1.0, "um": 1e-3}
_EMPTY = {"", "nan", "NaN", "NAN", "null", "None", "NA"}
_EPOCH_S = 1_000_000  # larger times count from a date: 100 ns would drown in a float


@dataclass(frozen=True, eq=False)
class RobotLog:
    """What a robot's log says: exact times (m,), and either `x_mm` (m, k, 3) or a pose R (m, 3, 3), t_mm (m, 3) of the tool.

    `opening_rad` (m,) is the full angle between the jaws, None without a gripper.
    """

    time: list[Decimal]
    x_mm: np.ndarray | None = None
    R: np.ndarray | None = None
    t_mm: np.ndarray | None = None
    opening_rad: np.ndarray | None = None


def decoded(path: Path) -> str:
    """The text of a file that another program wrote.

    Raises:
        FileNotFoundError, ValueError: Where there is none, or it is not UTF-8 (UTF-16 is read by its byte order mark).
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; the mapping names it.")
    data = path.read_bytes()
    try:
        return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: the text is not UTF-8. Save the file as CSV in UTF-8.") from None


def exact_seconds(text: str, unit: str, where: str) -> Decimal:
    """A time as exact seconds; "iso" dates without a zone count as UTC.

    >>> exact_seconds("1700000000123456789", "ns", "log.csv"), exact_seconds("1970-01-01T00:00:01.5", "iso", "log.csv")
    (Decimal('1700000000.123456789'), Decimal('1.5'))
    """
    try:
        if unit != "iso":
            value = Decimal(text.strip()) * _SECONDS[unit]
            if value.is_finite():
                return value
            raise ValueError
        date = datetime.fromisoformat(text.strip())
        date -= datetime.fromtimestamp(0, UTC) if date.tzinfo else datetime(1970, 1, 1)
        return Decimal(date.days * 86400 + date.seconds) + Decimal(date.microseconds) / 10**6
    except (ValueError, InvalidOperation):
        raise ValueError(f"{where}: {text.strip()!r} is not a time in {unit}. Check time, time_unit and decimal.") from None


def since(time: Iterable[Decimal], zero: Decimal) -> np.ndarray:
    """Exact times as float64 seconds after `zero`."""
    return np.array([float(t - zero) for t in time])


def increasing(time: list[Decimal], where: str, shortest_s: float, longest_s: float) -> Decimal:
    """Check times of rows or frames; returns their zero: 0, or the first whole second of times that count from a date.

    Raises:
        ValueError: Where times repeat or go back, or their step fits another unit.
    """
    for i in range(1, len(time)):
        if time[i] <= time[i - 1]:
            what = "repeats" if time[i] == time[i - 1] else "goes back"
            cure = "Sort the rows and drop the repeated ones, or name another column of times"
            raise ValueError(f"{where}: the time {what} at entry {i + 1} ({time[i - 1]} s, then {time[i]} s). {cure}.")
    step = float(np.median(np.diff(since(time, time[0])))) if len(time) > 1 else 1.0
    if not shortest_s <= step <= longest_s:
        plausible = f"{shortest_s} to {longest_s} s is plausible"
        raise ValueError(f"{where}: entries are {step:.3g} s apart, {plausible}. Check time_unit.")
    return Decimal(int(time[0])) if abs(time[0]) > _EPOCH_S else Decimal(0)


def read_columns(path: Path, table: Table, names: Iterable[str]) -> tuple[list[Decimal], dict[str, np.ndarray]]:
    """Exact times (m,) and the named columns, each (m,) float64 with NaN where a cell is empty, of a CSV file or a ROS bag.

    Raises:
        FileNotFoundError, ValueError: Naming file, line and column.
    """
    if path.suffix in (".bag", ".db3", ".mcap") or (path.is_dir() and (path / "metadata.yaml").is_file()):
        return _read_bag(path.parent if path.suffix in (".db3", ".mcap") else path, table, list(names))
    wanted, text = [table.time, *names], decoded(path)
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and line.lstrip()[0] not in "#%"]
    rows = csv.reader(io.StringIO("\n".join(line for _, line in lines)), delimiter=table.separator)
    header = [cell.strip() for cell in next(rows, [])]
    for name in wanted:
        if header.count(name) != 1:
            what = "two columns are" if name in header else "no column is"
            cure = "Check separator and names" if len(header) > 1 else f"Check separator = {table.separator!r}"
            raise ValueError(f"{path}, line {lines[0][0] if lines else 1}: {what} called {name!r}; it has {header}. {cure}.")
    at = [header.index(name) for name in wanted]
    time, values = [], np.full((max(len(lines) - 1, 0), len(at) - 1), np.nan)
    try:
        for row, cells in enumerate(rows):
            where = f"{path}, line {lines[min(row + 1, len(lines) - 1)][0]}"
            if len(cells) != len(header):
                what = f"{len(cells)} cells where the header has {len(header)}"
                raise ValueError(f"{where}: {what}. Check separator and decimal.")
            cells = [cells[i].strip().replace(table.decimal, ".") for i in at]
            time.append(exact_seconds(cells[0], table.time_unit, f"{where}, column {table.time}"))
            for k, cell in enumerate(cells[1:]):
                if cell not in _EMPTY:
                    values[row, k] = _number(cell, f"{where}, column {wanted[k + 1]}")
    except csv.Error as error:
        raise ValueError(f"{path}: not CSV ({error}). Export the table again.") from None
    if not time:
        raise ValueError(f"{path}: the table has no row. Export it again.")
    return time, dict(zip(wanted[1:], values[: len(time)].T, strict=True))


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.inf
    if not np.isfinite(value):
        raise ValueError(f"{where}: {cell!r} is not a finite number. Check decimal and separator, or leave the cell empty.")
    return value


def _read_bag(path: Path, table: Table, names: list[str]) -> tuple[list[Decimal], dict[str, np.ndarray]]:
    """Columns of a ROS 1 or 2 bag; columns of other topics than that of the time are interpolated at its times."""
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    fields: dict[str, list[tuple[str, list[str]]]] = {}
    for name in (table.time, *names):
        topic, _, field = name.partition(":")
        fields.setdefault(topic, []).append((name, field.split(".")))
    found: dict[str, list] = {name: [] for name in (table.time, *names)}
    stamps: dict[str, list[Decimal]] = {topic: [] for topic in fields}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            connections = [c for c in reader.connections if c.topic in fields]
            if missing := sorted(set(fields) - {c.topic for c in connections}):
                there = ", ".join(sorted({c.topic for c in reader.connections}))
                raise ValueError(f"{path}: no topic is called {missing[0]!r}; it has {there}.")
            for connection, received_ns, raw in reader.messages(connections=connections):
                message = reader.deserialize(raw, connection.msgtype)
                stamp = None
                for name, parts in fields[connection.topic]:
                    received = parts == ["received"]
                    value = Decimal(received_ns).scaleb(-9) if received else _field(message, parts, f"{path}: {name}")
                    stamp = value if isinstance(value, Decimal) else stamp
                    found[name].append(value)
                stamps[connection.topic].append(stamp if stamp is not None else _stamp(message, received_ns))
    except (AnyReaderError, OSError, KeyError, AttributeError, AssertionError) as error:
        raise ValueError(f"{path}: the bag cannot be read ({error}). Record or convert it again.") from None
    time = found[table.time]
    if not time or not isinstance(time[0], Decimal):
        raise ValueError(f"{path}: {table.time!r} is no time; name /topic:header.stamp or /topic:received.")
    columns, own = {}, table.time.partition(":")[0]
    for name in names:
        topic, values = name.partition(":")[0], np.array(found[name], np.float64)
        if topic != own:
            values = np.interp(since(time, time[0]), since(stamps[topic], time[0]), values, left=np.nan, right=np.nan)
        columns[name] = values
    return time, columns


def _field(message: object, parts: list[str], where: str) -> float | Decimal:
    for part in parts:
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
        raise ValueError(f"{where}: this field is no number; name one inside it.") from None


def _stamp(message: object, received_ns: int) -> Decimal:
    """The header's stamp, or the time of receipt where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return Decimal(received_ns).scaleb(-9) if stamp is None else Decimal(stamp.sec) + Decimal(stamp.nanosec).scaleb(-9)


def read_robot(folder: Path, mapping: Mapping) -> RobotLog:
    """The robot's log in mm, seconds and radians, in the robot frame that the mapping asks for.

    Raises:
        FileNotFoundError, ValueError: As `read_columns`; for rotations that are none; for an implausible unit.
    """
    robot, pose = mapping.robot, mapping.robot.pose
    path, scale = folder / robot.file, _MILLIMETRES[robot.length_unit]
    groups = [robot.landmarks[name] for name in mapping.landmarks] if pose is None else [pose.position]
    names = [name for group in groups for name in group]
    names += [] if pose is None else [*pose.rotation, *([pose.gripper] if pose.gripper else [])]
    time, columns = read_columns(path, robot, dict.fromkeys(names))
    x = np.stack([np.stack([columns[name] for name in group], axis=-1) for group in groups], axis=1) * scale
    x[np.isnan(x).any(axis=2)] = np.nan
    turn, shift = (np.eye(3), np.zeros(3)) if robot.frame is None else map(np.array, _checked_frame(path, robot))
    x = x @ turn.T + shift
    spread_mm = float(np.linalg.norm(np.nanpercentile(x, 95, axis=0) - np.nanpercentile(x, 5, axis=0), axis=1).max())
    if not 0.05 <= spread_mm <= 2000:
        what = f"with length_unit = {robot.length_unit!r} the tool moves over {spread_mm:.3g} mm"
        raise ValueError(f"{path}: {what}; 0.05 to 2000 mm is plausible. Check length_unit.")
    if pose is None:
        return RobotLog(time, x_mm=x)
    R = turn @ _rotations(path, pose, columns)
    return RobotLog(time, R=R, t_mm=x[:, 0], opening_rad=_opening(path, mapping, columns))


def _opening(path: Path, mapping: Mapping, columns: dict[str, np.ndarray]) -> np.ndarray | None:
    pose, length_mm = mapping.robot.pose, mapping.tool.jaw_length_mm
    if not pose.gripper:
        return None
    opening = columns[pose.gripper]
    if pose.gripper_unit == "mm":
        if length_mm is None or np.nanmax(np.abs(opening)) > 2 * length_mm:
            raise ValueError(f"{path}: a gripper in mm needs tool.jaw_length_mm, at least half the widest opening.")
        return 2 * np.arcsin(opening / (2 * length_mm))
    opening = np.deg2rad(opening) if pose.gripper_unit == "deg" else opening
    if np.nanmax(np.abs(opening)) > np.pi:
        raise ValueError(f"{path}: the gripper opens to {np.nanmax(np.abs(opening)):.3g} rad. Check gripper_unit.")
    return opening


def _rotations(path: Path, pose: Pose, columns: dict[str, np.ndarray]) -> np.ndarray:
    values = np.stack([columns[name] for name in pose.rotation], axis=-1)
    known = np.isfinite(values).all(axis=1)
    v, R = values[known], np.full((len(values), 3, 3), np.nan)
    if pose.rotation_kind == "matrix":
        found = v.reshape(-1, 3, 3)
        valid = np.abs(found @ found.transpose(0, 2, 1) - np.eye(3)).max(initial=0) < 1e-2
        valid = valid and (np.linalg.det(found) > 0).all()
        found = Rotation.from_matrix(found).as_matrix() if valid else found
    elif pose.rotation_kind.startswith("quaternion"):
        valid = (np.abs(np.linalg.norm(v, axis=1) - 1) < 1e-2).all()
        found = Rotation.from_quat(v, scalar_first=pose.rotation_kind.endswith("wxyz")).as_matrix() if valid else v
    else:
        euler, largest = pose.rotation_kind == "euler_xyz_deg", np.abs(v).max(initial=0)
        valid = largest <= (360 if euler else 2 * np.pi)
        found = (Rotation.from_euler("xyz", v, degrees=True) if euler else Rotation.from_rotvec(v)).as_matrix()
    if not valid:
        raise ValueError(f"{path}: columns {', '.join(pose.rotation)} are no {pose.rotation_kind}. Check rotation_kind.")
    R[known] = found
    return R


def _checked_frame(path: Path, robot: Robot) -> tuple:
    turn = np.array(robot.frame.rotation)
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-4 or np.linalg.det(turn) < 0:
        raise ValueError(f"{path}: robot.frame.rotation is no rotation: its rows must be orthonormal and right-handed.")
    return robot.frame.rotation, robot.frame.translation_mm
