"""Adaptation without a robot: training on labelled images of one camera."""

from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np

from lib import files
from lib.adapt.judging import better, frame_means
from lib.adapt.loop import RECIPE, STEPS, Adaptation, work_folder
from lib.correspondences import LANDMARKS
from lib.landmarks import Detector
from lib.landmarks.metrics import tool_length_px
from lib.provenance import Provenance, plain
from lib.recordings import read_image
from lib.recordings.annotations import CLICK_SD_PX, coco_keypoints
from lib.training.evaluation import evaluate
from lib.training.samples import LabelledImage, shown_by_coco
from lib.training.shards import simulated_like
from lib.training.stages import finetune


def adapt_images(
    images: str | Path, labels: str | Path, detector: Detector, *, minutes: float = 20.0, seed: int = 0,
    folder: str | Path | None = None, progress: bool = True, tune: Callable[..., Detector] = finetune,
) -> Adaptation:  # fmt: skip
    """`adapt` without a robot: at least 10 images of one camera in the folder `images`, with `labels` (COCO keypoints).

    In the order of their names, the first 65 % train, the next 15 % fit the error models, and the last 20 % judge.
    """
    images, marked = Path(images), []
    for name, names, values in sorted(coco_keypoints(Path(labels)), key=lambda entry: entry[0]):
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ValueError(f"{labels}: {name} lies outside {images}; give file names inside it.")
        if not set(LANDMARKS) <= set(names):
            raise ValueError(f"{labels}: image {name} has keypoints {names}; {list(LANDMARKS)} are needed.")
        xyv = values[[names.index(landmark) for landmark in LANDMARKS]]
        u, shown = np.where(xyv[:, 2:] > 0, xyv[:, :2], np.nan), shown_by_coco(xyv[:, 2].astype(int))
        if np.isfinite(tool_length_px(u)):
            marked.append(LabelledImage(name, read_image(images / name), u, shown, CLICK_SD_PX))
    n = len(marked)
    if n < 10:
        raise ValueError(f"{labels}: {n} images with a labelled base and tip; label at least 10.")
    second = min(round(0.8 * n), n - 3)
    first = min(round(0.65 * n), second - 2)
    parts = {"learn": marked[:first], "stop": marked[first:second], "judge": marked[second:]}
    report = {"recording": images.name, "weights": getattr(detector, "digest", "")[:12], "minutes": minutes, "seed": seed}
    report |= {"notes": [], "rounds": [], "frames": {name: len(part) for name, part in parts.items()}}
    key = [str(images.resolve()), Path(labels).read_bytes(), getattr(detector, "digest", ""), seed, minutes, STEPS, RECIPE]
    key += [files.digest(*(one.image.tobytes() for one in marked))]
    provenance = Provenance(f"python3 -m lib adapt {images.name} --labels {Path(labels).name}")
    simulated = simulated_like([one.image for one in parts["learn"]], seed, progress)
    how = {"minutes": minutes, "steps": STEPS, "seed": seed, "progress": progress}
    tuned = tune(detector, parts["learn"], parts["stop"], work_folder(folder, images.name, key), simulated=simulated, **how)
    before, after = (evaluate(one, parts["judge"]) for one in (detector, tuned))
    gain, sd = better(*(frame_means(found.error_px / found.length_px[:, None]) for found in (before, after)))
    improved = bool(gain > 2 * sd)
    report["judged"] = {
        name: {"median_px": s.median_px, "within_1_percent": s.pck_0_01, "within_5_percent": s.pck_0_05}
        for name, s in (("before", before.scores), ("after", after.scores))
    }
    report |= {
        "gain": {"labels": [gain, sd]}, "improved": improved,
        "reason": "the images for judging agree better with their labels" if improved else
        "on the images for judging the gain may be due to chance",
    }  # fmt: skip
    return Adaptation(tuned if improved else detector, None, plain(provenance.so_far() | report), improved, {})
