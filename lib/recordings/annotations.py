"""Landmark annotations as COCO keypoints, both cameras in one file."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from lib.correspondences import LANDMARKS
from lib.files import write_text

SIDES = ("left", "right")
#: Standard deviation of a label set by hand, in each coordinate.
CLICK_SD_PX = 1.5


@dataclass(frozen=True)
class Annotations:
    """Annotated landmarks of n frames, in the recording's order: base, tip_1, tip_2 of a forceps.

    Attributes:
        u_left, u_right: (n, k, 2) px, NaN where not labelled.
        visibility_left, visibility_right: (n, k) int as in COCO: 0 not labelled, 1 labelled but hidden, 2 visible; also -1
            for a landmark that the image does not show.  None = 2 wherever there is a label.
    """

    u_left: np.ndarray
    u_right: np.ndarray
    visibility_left: np.ndarray | None = None
    visibility_right: np.ndarray | None = None

    def __post_init__(self) -> None:
        for side in SIDES:
            u, v = np.asarray(getattr(self, f"u_{side}"), np.float64), getattr(self, f"visibility_{side}")
            v = np.full(u.shape[:2], 2) if v is None else np.asarray(v)
            if u.ndim != 3 or u.shape[2] != 2 or v.shape != u.shape[:2] or u.shape != np.shape(self.u_left):
                raise ValueError(f"u_{side}: expected (n, k, 2) with visibility (n, k), got {u.shape} and {v.shape}.")
            object.__setattr__(self, f"u_{side}", u)
            v = np.where(np.isfinite(u).all(axis=2), v, np.minimum(v, 0)).astype(np.int64)
            object.__setattr__(self, f"visibility_{side}", v)


def inside(u: np.ndarray, image_size_px: tuple[int, int]) -> np.ndarray:
    """True for pixels (..., 2) that lie in an image of (width, height); False for NaN."""
    return ((u >= -0.5) & (u <= np.subtract(image_size_px, 0.5))).all(axis=-1)


def coco_keypoints(path: Path) -> Iterator[tuple[str, list[str], np.ndarray]]:
    """Yield image, names (k,) and x, y, visibility (k, 3) of each annotation in a file of COCO keypoints.

    COCO cannot state that an image does not show a landmark.  Our own key ``absent`` lists such landmarks (visibility -1).
    """
    try:
        content = json.loads(path.read_bytes())
        categories = {c["id"]: [str(name) for name in c["keypoints"]] for c in content["categories"] if "keypoints" in c}
        images = {image["id"]: str(image["file_name"]) for image in content["images"]}
        entries = [(a["image_id"], a["category_id"], a["keypoints"], {*a.get("absent", ())}) for a in content["annotations"]]
        found = [(images.get(image), categories.get(category)) for image, category, *_ in entries]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        what = f"not COCO keypoints ({type(error).__name__}: {error})"
        raise ValueError(f"{path}: {what}. Export the annotations again.") from None
    for (image_id, category_id, keypoints, absent), (image, names) in zip(entries, found, strict=True):
        if names is None or image is None:
            where = f"category {category_id}, image {image_id}"
            raise ValueError(f"{path}: an annotation names {where}, which the file does not describe. Export it again.")
        try:
            values = np.array(keypoints, dtype=np.float64).reshape(len(names), 3)
        except (ValueError, TypeError):
            raise ValueError(f"{path}: image {image}: keypoints must be x, y, visibility for each name.") from None
        if not np.isin(values[:, 2], (0, 1, 2)).all():
            raise ValueError(f"{path}: image {image}: visibility is 0, 1 or 2.")
        values[[name in absent for name in names] & (values[:, 2] == 0), 2] = -1
        yield image, names, values


def read_coco(path: Path, n_frames: int, image_size_px: tuple[int, int], landmarks: Sequence[str] = LANDMARKS) -> Annotations:
    """Read COCO keypoints whose image names are ``left/000012.jpg`` and the like.

    The category's names state the order of the keypoints, which may be any; keypoints of other names are ignored.
    """
    u = np.full((2, n_frames, len(landmarks), 2), np.nan)
    visibility = np.zeros((2, n_frames, len(landmarks)), dtype=np.int64)
    seen = set()
    for image, names, values in coco_keypoints(path):
        file, where = PurePosixPath(image), f"{path}: image {image}"
        if not set(landmarks) <= set(names):
            raise ValueError(f"{where} has keypoints {names}; {list(landmarks)} are needed.")
        if file.parent.name not in SIDES or not file.stem.isdecimal() or int(file.stem) >= n_frames:
            raise ValueError(f"{where} is not a frame of this recording (left/000000.jpg to right/{n_frames - 1:06d}.jpg).")
        side, frame = at = SIDES.index(file.parent.name), int(file.stem)
        if at in seen:
            raise ValueError(f"{where} is annotated twice; a frame has one tool.")
        seen.add(at)
        xy, v = np.split(values[[names.index(landmark) for landmark in landmarks]], [2], axis=1)
        labelled = v[:, 0] > 0
        if not inside(xy[labelled], image_size_px).all():
            raise ValueError(f"{where}: a keypoint lies outside the image of {image_size_px[0]} x {image_size_px[1]} px.")
        u[side, frame, labelled], visibility[side, frame] = xy[labelled], v[:, 0]
    return Annotations(*u, *visibility)


def write_coco(
    path: Path, annotations: Annotations, image_size_px: tuple[int, int], suffix: str, landmarks: Sequence[str] = LANDMARKS
) -> None:
    """Write annotations as COCO keypoints; points that are NaN or outside the image are written as not labelled."""
    content = _empty(landmarks)
    images, entries = content["images"], content["annotations"]
    for side in SIDES:
        us, visibilities = getattr(annotations, f"u_{side}"), getattr(annotations, f"visibility_{side}")
        for frame, (u, visibility) in enumerate(zip(us, visibilities, strict=True)):
            images.append(_image(len(images) + 1, f"{side}/{frame:06d}{suffix}", image_size_px))
            v = np.where(inside(u, image_size_px), visibility, np.minimum(visibility, 0))
            if v.any():
                entry = {"id": len(entries) + 1, "image_id": images[-1]["id"], "category_id": 1}
                entries.append(_filled(entry, landmarks, landmarks, np.column_stack([u, v])))
    write_text(path, json.dumps(content, allow_nan=False) + "\n")


def mark_coco(path: Path, image: str, image_size_px: tuple[int, int], landmarks: Sequence[str], values: np.ndarray) -> None:
    """Set x, y, visibility (k, 3) of the landmarks in one image, in a file of COCO keypoints, which is made if missing.

    All else in the file stays: other images, other keypoints, other keys.
    """
    content = json.loads(path.read_bytes()) if path.exists() else _empty(landmarks)
    images, entries, categories = content["images"], content["annotations"], content["categories"]
    ids = [one["id"] for one in images if _place(one["file_name"]) == _place(image)]
    if not ids:
        ids = [1 + max((one["id"] for one in images), default=0)]
        images.append(_image(ids[0], image, image_size_px))
    at = next((k for k, one in enumerate(entries) if one["image_id"] in ids), len(entries))
    if at == len(entries):
        category = next((c for c in categories if set(landmarks) <= set(c.get("keypoints", ()))), None)
        if category is None:
            category = _empty(landmarks)["categories"][0] | {"id": 1 + max((c["id"] for c in categories), default=0)}
            categories.append(category)
        identity = 1 + max((one.get("id", 0) for one in entries), default=0)
        entries.append({"id": identity, "image_id": ids[0], "category_id": category["id"]})
    names = {c["id"]: c["keypoints"] for c in categories if "keypoints" in c}[entries[at]["category_id"]]
    entries[at] = _filled(entries[at], names, landmarks, values)
    write_text(path, json.dumps(content, allow_nan=False) + "\n")


def _place(file_name: str) -> tuple[str | int, ...]:
    """Folder and number of an image, so that left/3.png and left/000003.jpg are the same image."""
    *folder, stem = PurePosixPath(file_name).with_suffix("").parts[-2:]
    return (*folder, int(stem) if stem.isdecimal() else stem)


def _empty(landmarks: Sequence[str]) -> dict:
    edges = [[1, k] for k in range(2, len(landmarks) + 1)]
    category = {"id": 1, "name": "forceps" if len(edges) == 2 else "tool", "keypoints": list(landmarks), "skeleton": edges}
    info = {"description": "Tool landmarks; integer coordinates are pixel centres."}
    return {"info": info, "categories": [category], "images": [], "annotations": []}


def _image(identity: int, file_name: str, image_size_px: tuple[int, int]) -> dict:
    return {"id": identity, "file_name": file_name, "width": image_size_px[0], "height": image_size_px[1]}


def _filled(entry: dict, names: Sequence[str], landmarks: Sequence[str], values: np.ndarray) -> dict:
    """An image's entry with x, y, visibility (k, 3) of `landmarks` filled in; `names` are those of all its keypoints."""
    table = np.reshape(entry.get("keypoints", np.zeros(3 * len(names))), (-1, 3)).astype(np.float64)
    table[[names.index(name) for name in landmarks]] = np.where(values[:, 2:] > 0, values, 0.0)
    shown = table[table[:, 2] > 0, :2]
    low, size = (shown.min(axis=0), np.ptp(shown, axis=0)) if len(shown) else np.zeros((2, 2))
    entry["keypoints"] = [n for x, y, v in table.round(3).tolist() for n in (x, y, int(v))]
    entry |= {"num_keypoints": len(shown), "bbox": [*low.round(3).tolist(), *size.round(3).tolist()]}
    entry |= {"area": round(float(size.prod()), 3), "iscrowd": 0}
    absent = {name for name, v in zip(landmarks, values[:, 2], strict=True) if v < 0}
    absent |= set(entry.pop("absent", ())) - set(landmarks)
    return entry | ({"absent": sorted(absent)} if absent else {})
