"""``python3 -m lib adapt RECORDING``: weights, if the adaptation improved them, and one page that says what was done."""

import argparse
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader

from lib import files, paths
from lib.adapt.labels_only import adapt_images
from lib.adapt.loop import Adaptation, adapt
from lib.landmarks import Detector
from lib.recordings import Recording
from lib.trust.check import data_uri, overlay

__all__ = ["main", "write"]

_NUMBERS = {
    "median_px": "median distance from the robot, px",
    "median_sigmas": "the same in stated standard deviations (1.2 is right)",
    "within_1_percent": "within 1 % of the tool's length, %",
    "within_5_percent": "within 5 %, %",
    "within_10_percent": "within 10 %, %",
    "epipolar_px": "median distance of left and right from epipolar lines, px",
}


def write(found: Adaptation, folder: str | Path, recording: Recording | None = None) -> Path:
    """Write report.json, report.html and, if improved, weights.safetensors with its card into `folder`; returns the page.

    `recording` gives the pictures of the best, the median and the worst frame for judging.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if found.improved:
        found.detector.save(folder / "weights.safetensors")
        files.write_text(folder / "weights.md", _card(found.report))
    files.write_json(folder / "report.json", found.report)
    pictures = [] if recording is None or found.after is None else _pictures(found, recording)
    here = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
    shown = {"r": found.report, "numbers": _NUMBERS, "pictures": pictures, "curve": _curve(found.report)}
    page = here.get_template("adapt.html").render(**shown)
    files.write_text(folder / "report.html", page)
    return folder / "report.html"


def _pictures(found: Adaptation, recording: Recording) -> list[tuple[str, str]]:
    """(caption, picture) of frames for judging, before above after: the best, the median and the worst after."""
    order = np.argsort(found.after.relative)
    order = order[np.isfinite(found.after.relative[order])]
    pictures = []
    for name, i in zip(("best", "median", "worst"), (0, len(order) // 2, -1), strict=True) if len(order) else ():
        number = int(found.frames["judge"][order[i]])
        rows = [overlay(recording.frames[number], own.u[order[i]], found.told[order[i]], 520) for own in found.seen]
        share = 100 * found.after.relative[order[i]]
        caption = f"Frame {number}, the {name} after: mean distance {share:.2f} % of the tool. Above before, below after."
        pictures.append((caption, data_uri(np.vstack(rows), ".jpg")))
    return pictures


def _curve(report: dict) -> str:
    """The learning curve as a picture; empty without rounds."""
    rounds = [row for row in report.get("rounds", []) if row.get("mean_share") is not None]
    if len(rounds) < 2:
        return ""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 2.6), layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.subplots()
    axes.plot([row["round"] for row in rounds], [100 * row["mean_share"] for row in rounds], "o-", color="#0072b2")
    axes.set(xlabel="round of training", ylabel="distance, % of the tool", ylim=(0, None), xticks=range(len(rounds)))
    axes.set_title("frames for stopping: mean distance from the robot, at most 10 %")
    canvas.draw()
    return data_uri(np.asarray(canvas.buffer_rgba())[..., :3], ".png")


def _card(report: dict) -> str:
    """The card of adapted weights (Markdown)."""
    judged = report["judged"]
    rows = [f"| {text} | {judged['before'].get(k)} | {judged['after'].get(k)} |" for k, text in _NUMBERS.items()]
    return "\n".join([
        "# weights.safetensors", "",
        f"The landmark detector, adapted to the recording {report['recording']} by `{report['command']}`, {report['date']}.",
        f"Frames: {report['frames']}. The numbers are of the frames for judging, which took no part.", "",
        "| | before | after |", "|---|---|---|", *rows, "",
    ])  # fmt: skip


def main(argv: list[str]) -> int:
    """`python3 -m lib adapt`; exit code 0 where the weights improved, 3 where they were left alone, 2 for bad input."""
    parser = argparse.ArgumentParser(
        prog="python3 -m lib adapt", description="Let the robot of a recording teach the detector its landmarks."
    )
    add = parser.add_argument
    add("recording", type=Path, help="a recording; or a folder of images, which --labels names")
    add("--labels", type=Path, metavar="FILE", help="COCO keypoints, as annotations.json: 5 labelled pairs are a start")
    add("--minutes", type=float, default=20.0, help="of training (default: 20)")
    add("--out", type=Path, metavar="FOLDER", help="of weights, report.json and report.html (default: runs/adapt-NAME)")
    add("--weights", metavar="FILE", help="the detector to start from (default: the one that ships)")
    add("--seed", type=int, default=0)
    a = parser.parse_args(argv)
    if not 0 < a.minutes < 1e4:
        parser.error("--minutes: must be positive.")
    out, detector = a.out or paths.RUNS / f"adapt-{a.recording.resolve().name}", Detector.load(a.weights)
    how = {"minutes": a.minutes, "seed": a.seed, "folder": out}
    recording = None
    if a.recording.is_dir() and not (a.recording / "recording.toml").exists() and a.labels is not None:
        found = adapt_images(a.recording, a.labels, detector, **how)
    else:
        recording = Recording.open(a.recording, truth=False)
        found = adapt(recording, detector, labels=a.labels, **how)
    page = write(found, out, recording)
    print(f"{'Improved' if found.improved else 'Left alone'}: {found.report['reason']}.\nReport: {page}")
    return 0 if found.improved else 3
