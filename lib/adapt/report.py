"""``python3 -m lib adapt RECORDING``: writes new weights, if they are better, and a page that reports what was done."""

import argparse
import shlex
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, select_autoescape

from lib import files, paths
from lib.adapt.images import adapt_images
from lib.adapt.loop import Adaptation, adapt
from lib.landmarks import Detector
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.shaft import outlined
from lib.landmarks.windows import cut, map_points, tool_pose, window_from_image
from lib.recordings import Recording, StereoFrame
from lib.trust.check import data_uri, overlay

_SHOWN_PX = 520  # side of the part of an image that is shown; the tool takes 0.4 of it
_NUMBERS = {
    "median_px": "median distance from the robot, px",
    "median_sigmas": "the same in stated standard deviations (0.8 if these are right)",
    "within_1_percent": "within 1 % of the tool's length, %",
    "within_5_percent": "within 5 %, %",
    "within_10_percent": "within 10 %, %",
    "epipolar_px": "median epipolar distance between left and right, px",
}


def write(found: Adaptation, folder: str | Path, recording: Recording | None = None) -> Path:
    """Write report.json, report.html and, if improved, weights.safetensors and weights.md into `folder`.

    Returns the path of report.html.  With `recording` it shows the best, the median and the worst frame for judging.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    here = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=select_autoescape())
    if found.improved:
        found.detector.save(folder / "weights.safetensors")
        files.write_text(folder / "weights.md", here.get_template("weights.md").render(r=found.report, numbers=_NUMBERS))
    elif (folder / "weights.safetensors").exists():
        found.report["notes"] = [*found.report["notes"], "weights.safetensors in this folder is from an earlier run."]
    files.write_json(folder / "report.json", found.report)
    pictures = [] if recording is None or found.after is None else _pictures(found, recording)
    shaft = None if found.shaft is None else data_uri(outlined(found.shaft), ".png")
    page = here.get_template("adapt.html").render(r=found.report, numbers=_NUMBERS, pictures=pictures, shaft=shaft)
    files.write_text(folder / "report.html", page)
    return folder / "report.html"


def _pictures(found: Adaptation, recording: Recording) -> list[tuple[str, str]]:
    """(caption, picture) of the tool in the best, the median and the worst frame for judging, before (above) and after."""
    order = np.argsort(found.after.relative)[: np.isfinite(found.after.relative).sum()]
    pictures = []
    for name, i in zip(("best", "median", "worst"), (0, len(order) // 2, -1), strict=True) if len(order) else ():
        number = int(found.frames["judge"][order[i]])
        told, pair = found.told[order[i]], recording.frames[number]
        zoom = 0.4 * _SHOWN_PX / np.nanmax(tool_length_px(told))
        matrices = window_from_image(np.nan_to_num(tool_pose(told)[0]), np.zeros(2), _SHOWN_PX, zoom)
        views = [cut(view, matrix, _SHOWN_PX) for view, matrix in zip((pair.left, pair.right), matrices, strict=True)]
        u = [map_points(matrices[:, None], of_both) for of_both in (*(own.u[order[i]] for own in found.seen), told)]
        rows = [overlay(StereoFrame(*views, pair.time_s), seen, u[-1], _SHOWN_PX) for seen in u[:-1]]
        share = 100 * found.after.relative[order[i]]
        caption = f"Frame {number}, the {name} after: mean distance {share:.2f} % of the tool. Above: before. Below: after."
        pictures.append((caption, data_uri(np.vstack(rows), ".jpg")))
    return pictures


def main(argv: list[str]) -> int:
    """`python3 -m lib adapt`; exit code 0 if the weights improved, 3 if they were left unchanged, 2 for bad input."""
    parser = argparse.ArgumentParser(
        prog="python3 -m lib adapt", description="Let the robot of a recording teach the detector its landmarks."
    )
    add = parser.add_argument
    add("recording", type=Path, help="a recording; or a folder of images that --labels names")
    add("--labels", type=Path, metavar="FILE", help="COCO keypoints like annotations.json: 10 pairs are a good start")
    add("--minutes", type=float, default=20.0, help="minutes of training (default: 20)")
    add("--out", type=Path, metavar="FOLDER", help="for weights, report.json and report.html (default: runs/adapt-NAME)")
    add("--weights", metavar="FILE", help="the detector to start from (default: the one that ships)")
    add("--seed", type=int, default=0)
    a = parser.parse_args(argv)
    if not 0 < a.minutes < 1e4:
        parser.error(f"--minutes: must lie between 0 and 10000, got {a.minutes:g}.")
    images = a.recording.is_dir() and not (a.recording / "recording.toml").exists() and a.labels is not None
    recording = None if images else Recording.open(a.recording, truth=False)
    out = a.out or paths.results_folder(f"adapt-{a.recording.resolve().name}", a.recording)
    how = {"minutes": a.minutes, "seed": a.seed, "folder": out}
    if recording is None:
        found = adapt_images(a.recording, a.labels, Detector.load(a.weights), **how)
    else:
        found = adapt(recording, Detector.load(a.weights), labels=a.labels, **how)
    page = write(found, out, recording)
    where = shlex.quote(paths.shown(a.recording))
    reason = found.report["reason"].removesuffix(".")
    reason = f"{'Improved' if found.improved else 'Left alone'}: {reason}."
    print("\n".join([reason, *found.report["notes"]]).replace("RECORDING", where), f"Report: {page}", sep="\n")
    offset_s, sd_s = (found.report.get(name, np.nan) for name in ("offset_s", "clock_sd_s"))
    if recording is not None and abs(step_s := offset_s - recording.offset_s) > 3 * sd_s:
        text = f"The stated offset_s is wrong by {1e3 * step_s:.1f} ms, standard deviation {1e3 * sd_s:.1f} ms: "
        print(text + f"set offset_s = {offset_s:.4f} in {paths.shown(a.recording / 'recording.toml')}.")
    if recording is not None and found.improved:
        weights = shlex.quote(paths.shown(out / "weights.safetensors"))
        print(f"Next: python3 -m lib check {where} --weights {weights}, then calibrate with the same weights.")
    return 0 if found.improved else 3
