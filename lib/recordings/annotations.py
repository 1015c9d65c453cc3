"""Landmark annotations as COCO keypoints, both cameras in one file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from lib.recordings.tables import LANDMARKS, write_text

__all__ = ["Annotations", "read_coco", "write_coco"]

_SIDES = ("left", "right")


@dataclass(frozen=True)
class Annotations:
    """Annotated landmarks of n frames, in the order base, tip_1, tip_2.

    Attributes
    ----------
    u_left, u_right:
        (n, 3, 2) px, NaN where not labelled.
    visibility_left, visibility_right:
        (n, 3) int, COCO's: 0 not labelled, 1 labelled but hidden, 2 visible.
    """

    u_left: np.ndarray
    u_right: np.ndarray
    visibility_left: np.ndarray
    visibility_right: np.ndarray


def read_coco(path: Path, n_frames: int, image_size_px: tuple[int, int]) -> Annotations:
    """Read COCO keypoints whose image names are ``left/000012.jpg`` and the like.

    Keypoints are ordered by the names in the category, so any order on disk will do; extra keypoints are ignored.
    Coordinates follow the workbench: integers are pixel centres.

    Raises
    ------
    FileNotFoundError, ValueError
        Naming the file and the entry.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        categories = {c["id"]: list(c["keypoints"]) for c in content["categories"] if "keypoints" in c}
        images = {image["id"]: str(image["file_name"]) for image in content["images"]}
        entries = [(a["image_id"], a["category_id"], a["keypoints"]) for a in content["annotations"]]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not COCO keypoints ({type(error).__name__}: {error}).") from None
    width, height = image_size_px
    u = np.full((2, n_frames, 3, 2), np.nan)
    visibility = np.zeros((2, n_frames, 3), dtype=np.int64)
    seen = set()
    for image_id, category_id, keypoints in entries:
        names = categories.get(category_id)
        if names is None or image_id not in images:
            raise ValueError(f"{path}: an annotation names image {image_id}, category {category_id}; no such entry.")
        if not set(LANDMARKS) <= set(names):
            raise ValueError(f"{path}: category {category_id} has keypoints {names}; {list(LANDMARKS)} are needed.")
        file_name = PurePosixPath(images[image_id])
        if file_name.parent.name not in _SIDES or not file_name.stem.isdecimal() or int(file_name.stem) >= n_frames:
            raise ValueError(
                f"{path}: image {str(file_name)!r} is not a frame of this recording (left/000000.jpg ... "
                f"right/{n_frames - 1:06d}.jpg)."
            )
        side, frame = _SIDES.index(file_name.parent.name), int(file_name.stem)
        if (side, frame) in seen:
            raise ValueError(f"{path}: image {file_name} is annotated twice; one tool a frame.")
        seen.add((side, frame))
        try:
            values = np.array(keypoints, dtype=np.float64).reshape(len(names), 3)
        except (ValueError, TypeError):
            raise ValueError(f"{path}: image {file_name}: keypoints must be x, y, visibility for each name.") from None
        x, y, v = values[[names.index(landmark) for landmark in LANDMARKS]].T
        labelled = v > 0
        if not np.isin(v, (0, 1, 2)).all():
            raise ValueError(f"{path}: image {file_name}: visibility is 0, 1 or 2.")
        inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        if not inside[labelled].all():
            raise ValueError(f"{path}: image {file_name}: a keypoint lies outside the image of {width} x {height} px.")
        u[side, frame, labelled] = np.column_stack([x, y])[labelled]
        visibility[side, frame] = v
    return Annotations(u[0], u[1], visibility[0], visibility[1])


def write_coco(path: Path, annotations: Annotations, image_size_px: tuple[int, int], suffix: str) -> None:
    """Write `annotations`; points that are NaN or outside the image are written as not labelled."""
    width, height = image_size_px
    images, entries = [], []
    for side in _SIDES:
        us, visibilities = getattr(annotations, f"u_{side}"), getattr(annotations, f"visibility_{side}")
        for frame, (u, visibility) in enumerate(zip(us, visibilities, strict=True)):
            identity = len(images) + 1
            images.append(
                {"id": identity, "file_name": f"{side}/{frame:06d}{suffix}", "width": width, "height": height}
            )
            with np.errstate(invalid="ignore"):
                inside = ((u >= -0.5) & (u <= np.array([width, height]) - 0.5)).all(axis=1)
            v = np.where(inside, visibility, 0)
            if not v.any():
                continue
            labelled = u[v > 0]
            low, size = labelled.min(axis=0), np.ptp(labelled, axis=0)
            xy = np.where((v > 0)[:, None], u, 0.0).round(3)
            entries.append(
                {
                    "id": len(entries) + 1,
                    "image_id": identity,
                    "category_id": 1,
                    "keypoints": [
                        number for (x, y), w in zip(xy, v, strict=True) for number in (float(x), float(y), int(w))
                    ],
                    "num_keypoints": int((v > 0).sum()),
                    "bbox": [round(float(value), 3) for value in (*low, *size)],
                    "area": round(float(size.prod()), 3),
                    "iscrowd": 0,
                }
            )
    category = {"id": 1, "name": "forceps", "keypoints": list(LANDMARKS), "skeleton": [[1, 2], [1, 3]]}
    info = {"description": "Tool landmarks; integer coordinates are pixel centres."}
    content = {"info": info, "categories": [category], "images": images, "annotations": entries}
    write_text(path, json.dumps(content, allow_nan=False) + "\n")
