"""Labelled landmarks from COCO, CVAT, Label Studio, DeepLabCut and SLEAP, as annotations of a recording's frames."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from xml.etree.ElementTree import ParseError, fromstring
from zipfile import BadZipFile, ZipFile

import h5py
import numpy as np

from lib.importing.mapping import Labels
from lib.importing.video import StereoSource, last_number
from lib.recordings import Annotations
from lib.recordings.annotations import coco_keypoints, inside
from lib.recordings.tables import decoded, rows_of

_LARGEST_BYTES = 1 << 29  # largest unpacked label file, because a zip of a few kB can unpack to any size


class Label(NamedTuple):
    """One labelled landmark: image (path or frame number), the file's name of the landmark, pixel, and visibility 0, 1, 2."""

    image: str
    name: str
    x: float
    y: float
    visibility: int


def read_labels(
    folder: Path, labels: Labels, source: StereoSource, landmarks: Sequence[str], image_size_px: tuple[int, int]
) -> Annotations:
    """The labels of the imported frames; integer coordinates are pixel centres.

    Labels of other frames are left out.  If an image of the source holds both views, labels may refer to that image.
    """
    index_of = {labels.names.get(name, name): k for k, name in enumerate(landmarks)}
    frame_of = [{int(f): n for n, f in enumerate(side)} for side in source.index.T]
    of_files = ([n for n in reel.numbers if isinstance(n, int) and not labels.first_frame] for reel in source.reels)
    ends = [(min(own, default=0), max(own, default=0)) for own in of_files]  # lowest and highest number of a file
    width, height = image_size_px
    u, v = np.full((2, len(source.time), len(landmarks), 2), np.nan), np.zeros((2, len(source.time), len(landmarks)), int)
    files = [(labels.file, None)] if labels.file else [(f, s) for s, f in enumerate((labels.left, labels.right)) if f]
    found = [(folder / file, side, label) for file, side in files for label in labels_of(labels.kind, folder / file)]
    known, path = {label.name for _, _, label in found}, folder / files[-1][0]
    if missing := [name for name in index_of if name not in known]:
        cure = f"labels.names gives their name for each of {list(landmarks)}"
        raise ValueError(f"{path}: no label is called {missing[0]!r}; it has {sorted(known)}. {cure}.")
    for path, given, label in found:
        if label.name not in index_of or not label.visibility:
            continue
        where = f"{path}: {label.image}, {label.name}"
        xy = np.array([label.x, label.y]) - (0.5 if labels.pixel_origin == "corner" else 0.0)
        if given is not None:
            side = given
        elif source.video.layout != "two" and not any(name in label.image for name in labels.sides):
            axis, size = (0, width) if source.video.layout == "side_by_side" else (1, height)
            half = int(xy[axis] > size - 0.5)
            side, xy[axis] = half ^ source.video.exchanged, xy[axis] - half * size
        elif [name in label.image for name in labels.sides].count(True) == 1:
            side = int(labels.sides[1] in label.image)
        else:
            raise ValueError(f"{where}: the image's name must contain one of labels.sides = {list(labels.sides)}, not both.")
        reel = side ^ source.video.exchanged if source.video.layout == "two" else 0
        image = PurePosixPath(label.image.replace("\\", "/"))
        # A bare number counts frames.  A number in a name is that of a file, unless first_frame is given.
        number, of_file = last_number(image), {} if image.name.isdecimal() else source.reels[reel].numbers
        low, high = ends[reel] if of_file else (0, 0)
        nth = None if number is None or low < number < high else number - labels.first_frame
        frame = frame_of[reel].get(of_file.get(image.stem, of_file.get(number, nth) if high else nth))
        if frame is None:
            continue
        if not inside(xy, image_size_px):
            raise ValueError(f"{where}: ({xy[0]:.6g}, {xy[1]:.6g}) lies outside the image of {width} x {height} px.")
        k = index_of[label.name]
        if v[side, frame, k]:
            raise ValueError(f"{where}: labelled twice; a frame has one tool. Keep one label.")
        u[side, frame, k], v[side, frame, k] = xy, label.visibility
    if not v.any():
        cure = "Check labels.first_frame and the images' names"
        raise ValueError(f"{path}: none of its {len(found)} labels belongs to an imported frame. {cure}.")
    if np.nanmax(u) <= min(100, min(image_size_px) / 4):
        raise ValueError(f"{path}: no label beyond {np.nanmax(u):.4g} px; fractions or per cent of the image? Export pixels.")
    return Annotations(*u, *v)


def labels_of(kind: str, path: Path) -> Iterator[Label]:
    """The labels in a file of the given kind.  A file of another kind raises a ValueError, whatever its reader raised."""
    read, what = _READERS[kind]
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file; the mapping names it as labels.")
    try:
        yield from read(path)
    except (ValueError, LookupError, TypeError, AttributeError, RuntimeError, ParseError, BadZipFile, OSError) as error:
        if isinstance(error, ValueError) and str(path) in str(error):
            raise
        raise ValueError(f"{path}: not {what} ({type(error).__name__}: {error}). Export the labels again.") from None


def _coco(path: Path) -> Iterator[Label]:
    for image, names, values in coco_keypoints(path):
        for name, (x, y, v) in zip(names, values, strict=True):
            yield Label(image, name, x, y, int(v))


def _cvat(path: Path) -> Iterator[Label]:
    text = _from_zip(path, "annotations.xml") if path.suffix.lower() == ".zip" else decoded(path, utf_16=True)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError(f"{path}: the XML defines entities, which CVAT does not. Export it again.")
    root = fromstring(text)
    # A track is one landmark of a video; the points of a skeleton are nested and have their own labels.
    for parent in (*root.iter("image"), *root.iter("track")):
        for shape, points in ((s, p) for s in (parent, *parent.iter("skeleton")) for p in s.findall("points")):
            image = parent.get("name") or points.get("frame") or shape.get("frame") or ""
            name = points.get("label") or parent.get("label")
            if ";" in points.get("points"):
                raise ValueError(f"label {name!r} of {image} has several points; label each landmark on its own")
            x, y = map(float, points.get("points").split(","))
            yield Label(image, name, x, y, 0 if points.get("outside") == "1" else 1 if points.get("occluded") == "1" else 2)


def _from_zip(path: Path, name: str) -> str:
    with ZipFile(path) as archive:
        for entry in archive.namelist():  # nothing is unpacked, but no label tool exports such a file
            if entry.startswith("/") or ".." in PurePosixPath(entry.replace("\\", "/")).parts or ":" in entry:
                raise ValueError(f"{path}: it holds {entry!r}, which leads out of the folder. Export it again.")
        if archive.getinfo(name).file_size > _LARGEST_BYTES:
            raise ValueError(f"{path}: {name} unpacks to over {_LARGEST_BYTES >> 20} MB. Export fewer frames.")
        return archive.read(name).decode("utf-8-sig")


def _label_studio(path: Path) -> Iterator[Label]:
    for task in json.loads(path.read_bytes()):
        image = str(next(iter(task["data"].values())))
        results = (r for annotation in task["annotations"][:1] for r in annotation["result"])
        for result in (r for r in results if "keypointlabels" in r["value"]):
            value, size = result["value"], (result["original_width"], result["original_height"])
            if not (0 <= value["x"] <= 100 and 0 <= value["y"] <= 100):
                raise ValueError(f"{path}: {image}: ({value['x']}, {value['y']}) should be in percent of the image.")
            x, y = (value[axis] * length / 100 for axis, length in zip("xy", size, strict=True))
            yield Label(image, value["keypointlabels"][0], x, y, 2)


def _deeplabcut(path: Path) -> Iterator[Label]:
    if path.is_dir():
        if not (found := sorted(path.rglob("CollectedData*.csv"))):
            raise FileNotFoundError(f"{path}: no CollectedData_*.csv in it, which DeepLabCut writes beside each .h5.")
        for file in found:
            yield from _deeplabcut(file)
        return
    path = path.with_suffix(".csv")  # the same table, which DeepLabCut writes beside each .h5
    rows = [cells for _, cells in rows_of(path, decoded(path, utf_16=True))]
    named = {row[0]: i for i, row in enumerate(rows[:8])}
    top = named["coords"]
    n = rows[top].index("x")
    column = {key: i for i, key in enumerate(zip(rows[named["bodyparts"]], rows[top], strict=True))}
    for row in rows[top + 1 :]:
        for name in dict.fromkeys(rows[named["bodyparts"]][n:]):
            x, y = (float(row[column[name, axis]] or np.nan) for axis in "xy")
            yield Label("/".join(filter(None, row[:n])), name, x, y, 2 if np.isfinite([x, y]).all() else 0)


def _sleap(path: Path) -> Iterator[Label]:
    if path.suffix.lower() != ".slp":
        raise ValueError(f"{path}: of SLEAP only .slp is read, not the analysis files that it exports. Name the .slp.")
    with h5py.File(path) as file:
        metadata = json.loads(bytes(file["metadata"].attrs["json"]).decode())
        names = [metadata["nodes"][link["id"]]["name"] for link in metadata["skeletons"][0]["nodes"]]
        corner = 0.5 if file["metadata"].attrs.get("format_id", 2.0) < 1.1 else 0.0  # older SLEAP: the corner is (0, 0)
        videos = [json.loads(video)["backend"] for video in file["videos_json"][:]]
        instances, points = file["instances"][:], file["points"][:]
        for frame in file["frames"][:]:
            video, number = videos[frame["video"]], frame["frame_idx"]
            image = str(video["filenames"][number]) if video.get("filenames") else f"{video.get('filename', '')}/{number}"
            rows = instances[frame["instance_id_start"] : frame["instance_id_end"]]
            for instance in rows[rows["instance_type"] == 0]:  # 1 is a prediction
                for name, point in zip(names, points[instance["point_id_start"] : instance["point_id_end"]], strict=True):
                    seen = np.isfinite([point["x"], point["y"]]).all()
                    x, y = (float(point[axis]) - corner for axis in "xy")
                    yield Label(image, name, x, y, 2 if seen and point["visible"] else int(seen))


_READERS = {
    "coco": (_coco, "COCO keypoints"),
    "cvat": (_cvat, "CVAT's XML, or a zip that holds annotations.xml"),
    "label_studio": (_label_studio, "JSON of Label Studio"),
    "deeplabcut": (_deeplabcut, "labels of DeepLabCut"),
    "sleap": (_sleap, "a .slp file of SLEAP"),
}
