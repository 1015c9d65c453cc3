"""Labels without a robot: labelled images of one camera teach, stop and judge."""

import hashlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np

from lib import paths
from lib.adapt.judging import better, frame_means
from lib.adapt.loop import RECIPE, STEPS, Adaptation, simulated_like
from lib.correspondences import LANDMARKS
from lib.landmarks import Detector
from lib.provenance import Provenance, plain
from lib.recordings import read_image
from lib.recordings.annotations import CLICK_SD_PX, coco_keypoints
from lib.training.evaluation import evaluate
from lib.training.samples import LabelledImage
from lib.training.stages import finetune

__all__ = ["adapt_images"]


def adapt_images(
    images: str | Path, labels: str | Path, detector: Detector, *, minutes: float = 20.0, seed: int = 0,
    folder: str | Path | None = None, progress: bool = True, tune: Callable[..., Detector] = finetune,
) -> Adaptation:  # fmt: skip
    """Train the detector further on labelled images of one camera: `adapt` where there is no robot.

    The first 65 % of them in the order of their names teach, the next fit the doubt, the last fifth judge.

    Args:
        images: Folder to which the file names in `labels` belong.
        labels: COCO keypoints base, tip_1, tip_2.

    Raises:
        FileNotFoundError, ValueError: If a file is missing, or fewer than 10 images are labelled.
    """
    images, marked = Path(images), []
    for name, names, values in sorted(coco_keypoints(Path(labels)), key=lambda entry: entry[0]):
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ValueError(f"{labels}: {name} lies outside {images}; give file names inside it.")
        if not set(LANDMARKS) <= set(names):
            raise ValueError(f"{labels}: image {name} has keypoints {names}; {list(LANDMARKS)} are needed.")
        xyv = values[[names.index(landmark) for landmark in LANDMARKS]]
        u = np.where(xyv[:, 2:] > 0, xyv[:, :2], np.nan)
        marked.append(LabelledImage(name, read_image(images / name), u, np.maximum(xyv[:, 2].astype(int), 1), CLICK_SD_PX))
    n = len(marked)
    if n < 10:
        raise ValueError(f"{labels}: {n} labelled images; label at least 10.")
    first, second = round(0.65 * n), round(0.8 * n)
    parts = {"learn": marked[:first], "stop": marked[first:second], "judge": marked[second:]}
    report = {"recording": images.name, "minutes": minutes, "seed": seed, "notes": [], "rounds": []}
    report |= {"frames": {name: len(part) for name, part in parts.items()}}
    key = [str(images.resolve()), Path(labels).read_bytes(), getattr(detector, "digest", ""), seed, minutes, STEPS, RECIPE]
    work = Path(folder or paths.RUNS / f"adapt-{images.name}") / "work" / hashlib.sha256(repr(key).encode()).hexdigest()[:12]
    provenance = Provenance(f"python3 -m lib adapt {images.name} --labels {Path(labels).name}")
    simulated = simulated_like([one.image for one in parts["learn"]], seed, progress)
    how = {"minutes": minutes, "steps": STEPS, "seed": seed, "progress": progress}
    tuned = tune(detector, parts["learn"], parts["stop"], work, simulated=simulated, **how)
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
        "on the images for judging the gain is no larger than chance allows",
    }  # fmt: skip
    return Adaptation(tuned if improved else detector, None, plain(report | provenance.so_far()), improved, {})
