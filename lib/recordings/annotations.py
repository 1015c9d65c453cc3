"""Landmark annotations as COCO keypoints, both cameras in one file."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from lib.correspondences import LANDMARKS
from lib.files import write_text

__all__ = ["Annotations", "read_coco", "write_coco"]

_SIDES = ("left", "right")


@dataclass(frozen=True)
class Annotations:
    """Annotated landmarks of n frames, in the recording's order: base, tip_1, tip_2 of a forceps.

    Attributes:
        u_left, u_right: (n, k, 2) px, NaN where not labelled.
        visibility_left, visibility_right: (n, k) int as in COCO: 0 not labelled, 1 labelled but hidden, 2 visible.
            None = 2 wherever there is a label.
    """

    u_left: np.ndarray
    u_right: np.ndarray
    visibility_left: np.ndarray | None = None
    visibility_right: np.ndarray | None = None

    def __post_init__(self) -> None:
        for side in _SIDES:
            u, v = np.asarray(getattr(self, f"u_{side}"), np.float64), getattr(self, f"visibility_{side}")
            v = np.full(u.shape[:2], 2) if v is None else np.asarray(v)
            if u.ndim != 3 or u.shape[2] != 2 or v.shape != u.shape[:2] or u.shape != np.shape(self.u_left):
                raise ValueError(f"u_{side}: expected (n, k, 2) with visibility (n, k), got {u.shape} and {v.shape}.")
            object.__setattr__(self, f"u_{side}", u)
            object.__setattr__(self, f"visibility_{side}", np.where(np.isfinite(u).all(axis=2), v, 0).astype(np.int64))


def read_coco(
    path: Path, n_frames: int, image_size_px: tuple[int, int], landmarks: Sequence[str] = LANDMARKS
) -> Annotations:
    """Read COCO keypoints whose image names are ``left/000012.jpg`` and the like.

    The names in the category order the keypoints, so any order in the file will do; other keypoints are ignored.
    Integer coordinates are pixel centres.

    Raises:
        FileNotFoundError, ValueError: Naming the file and the entry.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        categories = {c["id"]: list(c["keypoints"]) for c in content["categories"] if "keypoints" in c}
        images = {image["id"]: str(image["file_name"]) for image in content["images"]}
        found = content["annotations"]
        entries = [(images.get(a["image_id"]), categories.get(a["category_id"]), a["keypoints"], a) for a in found]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        what = f"not COCO keypoints ({type(error).__name__}: {error})"
        raise ValueError(f"{path}: {what}. Export the annotations again.") from None
    width, height = image_size_px
    u = np.full((2, n_frames, len(landmarks), 2), np.nan)
    visibility = np.zeros((2, n_frames, len(landmarks)), dtype=np.int64)
    seen = set()
    for image, names, keypoints, entry in entries:
        where = f"image {entry['image_id']}, category {entry['category_id']}"
        if names is None or image is None:
            raise ValueError(f"{path}: an annotation names {where}; no such entry.")
        if not set(landmarks) <= set(names):
            raise ValueError(f"{path}: {where} has keypoints {names}; {list(landmarks)} are needed.")
        file = PurePosixPath(image)
        if file.parent.name not in _SIDES or not file.stem.isdecimal() or int(file.stem) >= n_frames:
            known = f"left/000000.jpg to right/{n_frames - 1:06d}.jpg"
            raise ValueError(f"{path}: image {image!r} is not a frame of this recording ({known}).")
        side, frame = _SIDES.index(file.parent.name), int(file.stem)
        if (side, frame) in seen:
            raise ValueError(f"{path}: image {file} is annotated twice; a frame has one tool.")
        seen.add((side, frame))
        try:
            values = np.array(keypoints, dtype=np.float64).reshape(len(names), 3)
        except (ValueError, TypeError):
            raise ValueError(f"{path}: image {file}: keypoints must be x, y, visibility for each name.") from None
        x, y, v = values[[names.index(landmark) for landmark in landmarks]].T
        if not np.isin(v, (0, 1, 2)).all():
            raise ValueError(f"{path}: image {file}: visibility is 0, 1 or 2.")
        inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        if not inside[v > 0].all():
            raise ValueError(f"{path}: image {file}: a keypoint lies outside the image of {width} x {height} px.")
        u[side, frame, v > 0] = np.column_stack([x, y])[v > 0]
        visibility[side, frame] = v
    return Annotations(u[0], u[1], visibility[0], visibility[1])


def write_coco(
    path: Path, annotations: Annotations, image_size_px: tuple[int, int], suffix: str, landmarks: Sequence[str] = LANDMARKS
) -> None:
    """Write `annotations`; points that are NaN or outside the image are written as not labelled."""
    width, height = image_size_px
    images, entries = [], []
    for side in _SIDES:
        us, visibilities = getattr(annotations, f"u_{side}"), getattr(annotations, f"visibility_{side}")
        for frame, (u, visibility) in enumerate(zip(us, visibilities, strict=True)):
            identity, file_name = len(images) + 1, f"{side}/{frame:06d}{suffix}"
            images.append({"id": identity, "file_name": file_name, "width": width, "height": height})
            with np.errstate(invalid="ignore"):
                inside = ((u >= -0.5) & (u <= np.array([width, height]) - 0.5)).all(axis=1)
            v = np.where(inside, visibility, 0)
            if not v.any():
                continue
            low, size = u[v > 0].min(axis=0), np.ptp(u[v > 0], axis=0)
            xy = np.where((v > 0)[:, None], u, 0.0).round(3)
            entry = {"id": len(entries) + 1, "image_id": identity, "category_id": 1}
            entry["keypoints"] = [n for (x, y), w in zip(xy.tolist(), v.tolist(), strict=True) for n in (x, y, w)]
            entry |= {"num_keypoints": int((v > 0).sum()), "bbox": [round(float(value), 3) for value in (*low, *size)]}
            entries.append(entry | {"area": round(float(size.prod()), 3), "iscrowd": 0})
    edges = [[1, k] for k in range(2, len(landmarks) + 1)]
    category = {"id": 1, "name": "forceps" if len(edges) == 2 else "tool", "keypoints": list(landmarks), "skeleton": edges}
    content = {"info": {"description": "Tool landmarks; integer coordinates are pixel centres."}, "categories": [category]}
    write_text(path, json.dumps(content | {"images": images, "annotations": entries}, allow_nan=False) + "\n")
