"""The shipped recording as other programs would have written it: small frames, the same robot, the same labels."""

import csv
import json
import zipfile
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from lib import paths
from lib.calibration import Tool
from lib.correspondences import LANDMARKS
from lib.geometry import RigidTransform
from lib.recordings import Annotations, Recording

CLOCK_S = 0.183
NAMES = {"base": "joint", "tip_1": "jaw left", "tip_2": "jaw right"}
POSES = (
    '[robot]\nfile = "pose.tsv"\nseparator = "\\t"\ntime = "stamp_ns"\ntime_unit = "ns"\nlength_unit = "um"\n'
    'offset_s = 1700000000\n[robot.pose]\nposition = ["px", "py", "pz"]\nrotation = ["qw", "qx", "qy", "qz"]\n'
    'rotation_kind = "quaternion_wxyz"\ngripper = "jaw_deg"\ngripper_unit = "deg"\n'
)
#: The forceps of the shipped recording, as its 4367 reports of the robot tell it.
JAWS = Tool.hinged(np.zeros((3, 3)), [0, 1, -1], [0, 0, 0], [0, 0, 1], [2.988, 0, 0])


@dataclass(frozen=True, eq=False)
class Shipped:
    """Frames (n, 2, h, w, 3) uint8 RGB, reduced by `reduction`; their times, labels, and the robot's log."""

    frames: np.ndarray
    time_s: np.ndarray
    labels: Annotations
    robot_s: np.ndarray
    x_mm: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        return self.frames.shape[3], self.frames.shape[2]


@lru_cache(maxsize=1)
def shipped(reduction: int = 8) -> Shipped:
    """Read once in a process; nobody can change its frames."""
    recording = Recording.open(paths.SHIPPED_RECORDING)
    flag = {1: cv2.IMREAD_COLOR_RGB, 8: cv2.IMREAD_REDUCED_COLOR_8}[reduction]
    frames = np.array([
        [cv2.imread(str(path), flag) for path in pair]
        for pair in zip(*(sorted((paths.SHIPPED_RECORDING / side).iterdir()) for side in ("left", "right")), strict=True)
    ])  # fmt: skip
    frames = frames[:, :, : frames.shape[2] // 2 * 2]
    frames.setflags(write=False)
    u = [(getattr(recording.annotations, f"u_{side}") + 0.5) / reduction - 0.5 for side in ("left", "right")]
    u = [np.where((side <= np.array(frames.shape[3:1:-1]) - 0.5).all(axis=2, keepdims=True), side, np.nan) for side in u]
    return Shipped(frames, recording.frames.time_s, Annotations(*u), recording.kinematics.time_s, recording.kinematics.x_mm)


def posed(source: Shipped) -> tuple[list[RigidTransform], np.ndarray, np.ndarray]:
    """Poses of the tool and openings (m,) rad nearest to the robot's landmarks, and the landmarks then (m, 3, 3)."""
    x = source.x_mm
    opening = 2 * np.arcsin(np.clip(np.linalg.norm(x[:, 1] - x[:, 2], axis=1) / 2 / 2.988, 0, 0.99))
    shape = JAWS.positions_mm([RigidTransform.identity()] * len(x), opening)
    middle, other = shape.mean(axis=1, keepdims=True), x.mean(axis=1, keepdims=True)
    left, _, right = np.linalg.svd(np.einsum("nki,nkj->nij", x - other, shape - middle))
    flip = np.stack([np.ones(len(x)), np.ones(len(x)), np.linalg.det(left @ right)], axis=1)
    R = (left * flip[:, None]) @ right
    poses = [RigidTransform(r, t) for r, t in zip(R, (other - np.einsum("nij,nkj->nki", R, middle))[:, 0], strict=True)]
    return poses, opening, JAWS.positions_mm(poses, opening)


def video(
    path: Path, images: np.ndarray, time_s: np.ndarray, codec: str = "libx264", pix_fmt: str = "yuv420p", gop: int = 12,
    aspect: Fraction | None = None, interlaced: bool = False,
) -> None:  # fmt: skip
    """A video whose frames carry these times, of images (n, h, w, 3) or (n, h, w), with a key frame in each `gop` frames."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt, stream.gop_size = *images.shape[1:3], pix_fmt, gop
        stream.time_base = stream.codec_context.time_base = Fraction(1, 90000)
        if aspect:  # width of a pixel over its height
            stream.codec_context.sample_aspect_ratio = aspect
        stream.options = {"crf": "15", "preset": "ultrafast"} if codec == "libx264" else {}
        stream.options = stream.options | ({"x264-params": "tff=1"} if interlaced else {})
        for image, time in zip(images, time_s, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format={"uint16": "gray16le"}.get(str(image.dtype), "rgb24"))
            frame.pts, frame.time_base = round(time * 90000), Fraction(1, 90000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def cut(old: Path, new: Path, first: int = 0, zero_s: Fraction = Fraction(0)) -> None:
    """Copy a video as `ffmpeg -c copy` does: packets from number `first` on, times from `zero_s` on."""
    with av.open(str(old)) as source, av.open(str(new), "w", format={".ts": "mpegts"}.get(new.suffix)) as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream)
        for packet in [packet for packet in source.demux(stream) if packet.dts is not None][first:]:
            packet.pts, packet.dts = (round(t - zero_s / stream.time_base) for t in (packet.pts, packet.dts))
            packet.stream = copy
            target.mux(packet)


def side_by_side(folder: Path, source: Shipped) -> str:
    video(folder / "stereo.mp4", np.concatenate([source.frames[:, 0], source.frames[:, 1]], axis=2), source.time_s)
    return '[video]\nlayout = "side_by_side"\nfile = "stereo.mp4"\n'


def images(folder: Path, source: Shipped) -> str:
    """Two folders of TIFF images, named by nanoseconds."""
    plain = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE]
    for side, name in enumerate(("cam L", "cam R")):
        (folder / name).mkdir()
        for image, time in zip(source.frames[:, side], source.time_s, strict=True):
            data = cv2.imencode(".tiff", image[..., ::-1], plain)[1]
            (folder / name / f"f_{round(1e9 * time):012d}.tiff").write_bytes(data.tobytes())
    return '[video]\nlayout = "two"\nleft = "cam L/*.tiff"\nright = "cam R/*.tiff"\ntimes = "names"\nname_unit = "ns"\n'


def robot_csv(folder: Path, source: Shipped, name: str = "log.csv") -> str:
    """Plain CSV in mm and seconds on the video's clock."""
    columns = [f"{landmark}_{axis}" for landmark in LANDMARKS for axis in "xyz"]
    table = np.column_stack([source.robot_s, source.x_mm.reshape(len(source.x_mm), 9)])
    np.savetxt(folder / name, table, "%.6f", ",", header=",".join(["time_s", *columns]), comments="")
    text = ", ".join(f'{landmark} = ["{landmark}_x", "{landmark}_y", "{landmark}_z"]' for landmark in LANDMARKS)
    return f'[robot]\nfile = "{name}"\ntime = "time_s"\nlength_unit = "mm"\nlandmarks = {{ {text} }}\n'


def robot_foreign_csv(folder: Path, source: Shipped) -> str:
    """Metres, milliseconds, semicolons, decimal commas, CRLF, a BOM, another base frame, a clock that is 183 ms ahead."""
    turn, shift = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, -20, 30])
    x = (source.x_mm - shift) @ turn
    rows = ["t [ms];" + ";".join(f"{p} {axis} [m]" for p in "PQS" for axis in "xyz") + ";note"]
    for time, row in zip(source.robot_s + CLOCK_S, x.reshape(len(x), 9) / 1e3, strict=True):
        rows.append(";".join([f"{1e3 * time:.4f}", *(f"{value:.9f}" for value in row)]).replace(".", ",") + ";ok")
    (folder / "log.csv").write_bytes("\r\n".join([*rows, ""]).encode("utf-8-sig"))
    points = ", ".join(
        f'{name} = ["{p} x [m]", "{p} y [m]", "{p} z [m]"]' for name, p in zip(LANDMARKS, "PQS", strict=True)
    )
    return (
        '[robot]\nfile = "log.csv"\nseparator = ";"\ndecimal = ","\ntime = "t [ms]"\ntime_unit = "ms"\nlength_unit = "m"\n'
        f'offset_s = "estimate"\nlandmarks = {{ {points} }}\n'
        "frame = { rotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], translation_mm = [10, -20, 30] }\n"
    )


def robot_poses(folder: Path, source: Shipped) -> str:
    """Pose and gripper only, in micrometres, with dates in nanoseconds."""
    poses, opening, _ = posed(source)
    turns = Rotation.from_matrix(np.stack([pose.R for pose in poses])).as_quat(scalar_first=True)
    with open(folder / "pose.tsv", "w", newline="") as file:
        writer = csv.writer(file, delimiter="\t")
        writer.writerow(["stamp_ns", "px", "py", "pz", "qw", "qx", "qy", "qz", "jaw_deg"])
        for time, pose, quaternion, angle in zip(source.robot_s, poses, turns, opening, strict=True):
            numbers = [f"{v:.4f}" for v in 1e3 * pose.t] + [f"{v:.9f}" for v in (*quaternion, np.rad2deg(angle))]
            writer.writerow([1_700_000_000_000_000_000 + round(1e9 * time), *numbers])
    return POSES


def robot_bag(folder: Path, source: Shipped, version: int = 2, ahead_s: float = 0.0) -> str:
    """A ROS bag with one topic of points a landmark, in metres, on the video's clock after a date; stamps are `ahead_s`."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if version == 2 else Stores.ROS1_NOETIC)
    names = "geometry_msgs/msg/PointStamped geometry_msgs/msg/Point std_msgs/msg/Header builtin_interfaces/msg/Time"
    stamped, point, header, at = (store.types[name] for name in names.split())
    with Writer2(folder / "bag", version=9) if version == 2 else Writer1(folder / "log.bag") as writer:
        topics = [writer.add_connection(f"/{name}", stamped.__msgtype__, typestore=store) for name in LANDMARKS]
        for time, x in zip(source.robot_s, source.x_mm, strict=True):
            received_ns = 1_700_000_000_000_000_000 + round(1e9 * time)
            ns = received_ns + round(1e9 * ahead_s)
            sequence = {} if version == 2 else {"seq": 0}
            for topic, mm in zip(topics, x, strict=True):
                if np.isnan(mm).any():  # this topic is silent
                    continue
                stamp = header(stamp=at(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="robot", **sequence)
                message = stamped(header=stamp, point=point(*(float(v) / 1e3 for v in mm)))
                data = store.serialize_cdr if version == 2 else store.serialize_ros1
                writer.write(topic, received_ns, data(message, stamped.__msgtype__))
    points = ", ".join(f'{n} = ["/{n}:point.x", "/{n}:point.y", "/{n}:point.z"]' for n in LANDMARKS)
    file = "bag" if version == 2 else "log.bag"
    return (
        f'[robot]\nfile = "{file}"\ntime = "/base:header.stamp"\nlength_unit = "m"\noffset_s = 1700000000\n'
        f"landmarks = {{ {points} }}\n"
    )


def labels_coco(folder: Path, source: Shipped) -> str:
    images, entries = [], []
    for side, u in (("left", source.labels.u_left), ("right", source.labels.u_right)):
        for frame, points in enumerate(u):
            images.append({"id": len(images), "file_name": f"{side}/{frame:05d}.png"})
            keypoints = [v for x, y in points[::-1] for v in ((float(x), float(y), 2) if np.isfinite(x) else (0, 0, 0))]
            entries.append({"id": len(images), "image_id": len(images) - 1, "category_id": 7, "keypoints": keypoints})
    content = {"categories": [{"id": 7, "keypoints": list(NAMES.values())[::-1]}], "images": images, "annotations": entries}
    (folder / "person_keypoints.json").write_text(json.dumps(content))
    return _labels("coco", 'file = "person_keypoints.json"')


def labels_deeplabcut(folder: Path, source: Shipped) -> str:
    for side, u in (("left", source.labels.u_left), ("right", source.labels.u_right)):
        (folder / f"labeled-data {side}").mkdir()
        rows = [["scorer", "", ""] + ["Ann"] * 6, ["bodyparts", "", ""] + [n for n in NAMES.values() for _ in "xy"]]
        rows.append(["coords", "", ""] + ["x", "y"] * 3)
        for frame, points in enumerate(u):
            cells = ["" if np.isnan(value) else f"{value:.6f}" for value in points.ravel()]
            rows.append(["labeled-data", f"video {side}", f"img{frame:04d}.png", *cells])
        with open(folder / f"labeled-data {side}" / "CollectedData_Ann.csv", "w", newline="") as file:
            csv.writer(file).writerows(rows)
    return _labels("deeplabcut", 'left = "labeled-data left"\nright = "labeled-data right"')


def labels_cvat(folder: Path, source: Shipped) -> str:
    lines = ['<?xml version="1.0" encoding="utf-8"?><annotations><version>1.1</version>']
    for frame in range(len(source.frames)):
        for side, u in (("right", source.labels.u_right), ("left", source.labels.u_left)):
            lines.append(f'<image id="{frame}" name="{side} view/frame_{frame:06d}.PNG" width="1" height="1">')
            for name, (x, y) in list(zip(NAMES.values(), u[frame], strict=True))[::-1]:
                if np.isfinite(x):
                    lines.append(f'<points label="{name}" occluded="0" points="{x + 0.5:.2f},{y + 0.5:.2f}" z_order="0"/>')
            lines.append("</image>")
    with zipfile.ZipFile(folder / "task_1.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("annotations.xml", "".join([*lines, "</annotations>"]))
    return _labels("cvat", 'file = "task_1.zip"\npixel_origin = "corner"')


def labels_label_studio(folder: Path, source: Shipped) -> str:
    """Per cent of the whole side-by-side image."""
    (width, height), tasks = source.size, []
    for frame in range(len(source.frames)):
        results = []
        for side, u in enumerate((source.labels.u_left, source.labels.u_right)):
            for name, (x, y) in zip(NAMES.values(), u[frame], strict=True):
                value = {"x": 100 * (x + 0.5 + side * width) / (2 * width), "y": 100 * (y + 0.5) / height, "width": 0.1}
                value["keypointlabels"] = [name]
                if np.isfinite(x):
                    results.append({"original_width": 2 * width, "original_height": height, "value": value})
        tasks.append({"data": {"img": f"/data/upload/1/ab12-{frame:04d}.png"}, "annotations": [{"result": results}]})
    (folder / "project-1.json").write_text(json.dumps(tasks))
    return _labels("label_studio", 'file = "project-1.json"\npixel_origin = "corner"')


def labels_sleap(folder: Path, source: Shipped) -> str:
    for side, u in (("left", source.labels.u_left), ("right", source.labels.u_right)):
        n = len(u)
        with h5py.File(folder / f"{side}.slp", "w") as file:
            nodes = [{"name": name} for name in NAMES.values()]
            skeleton = {"nodes": [{"id": k} for k in range(3)]}
            told = json.dumps({"nodes": nodes, "skeletons": [skeleton]})
            group = file.create_group("metadata")
            group.attrs["json"], group.attrs["format_id"] = np.bytes_(told), 1.2
            file["videos_json"] = [np.bytes_(json.dumps({"backend": {"filename": f"{side}.mp4"}}))]
            index = np.arange(n)
            file["frames"] = _records(frame_id=index, video=0 * index, frame_idx=index, instance_id_start=index,
                                      instance_id_end=index + 1)  # fmt: skip
            file["instances"] = _records(instance_type=0 * index, point_id_start=3 * index, point_id_end=3 * index + 3)
            xy = u.reshape(-1, 2)
            file["points"] = _records(x=xy[:, 0], y=xy[:, 1], visible=np.isfinite(xy[:, 0]))
    return _labels("sleap", 'left = "left.slp"\nright = "right.slp"')


def _records(**columns: np.ndarray) -> np.ndarray:
    table = np.empty(len(next(iter(columns.values()))), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table


def _labels(kind: str, files: str) -> str:
    names = ", ".join(f'{name} = "{theirs}"' for name, theirs in NAMES.items())
    return f'[labels]\nkind = "{kind}"\n{files}\nnames = {{ {names} }}\n'
