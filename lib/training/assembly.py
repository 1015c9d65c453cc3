"""From trained stages to the shipped detector: join, calibrate, measure, write the weights and their card."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

from lib.landmarks import Detector
from lib.landmarks.windows import CLOSEUP_ZOOM
from lib.provenance import commit_id, machine
from lib.recordings import Recording
from lib.training.evaluation import calibrate, evaluate, labelled_frames
from lib.training.loop import PRESETS, load_training
from lib.training.samples import REDUCTION, TOOL_REDUCTION, validation_frames

__all__ = ["assemble"]

#: So many images of each recording go into the calibration, from its beginning to its end.
_IMAGES = 16


def assemble(
    folder: str | Path,
    data: str | Path,
    out: str | Path,
    recordings: Sequence[str | Path] = (),
    notes: Sequence[str] = (),
) -> Detector:
    """Join ``frame/``, ``tool/``, ``window/`` and ``closeup/`` of a training folder, calibrate, write `out` and its card.

    Half of the validation frames calibrate, the other half give the figures on the card; then all calibrate.  Labelled
    `recordings` calibrate too where there are any: moderate frames as they will be measured, where the validation frames
    vary more than those of any microscope.  None of either was trained on.  The card ends with `notes`: what a reader should
    know of the trainings and the checkpoints do not tell.

    Raises
    ------
    FileNotFoundError, ValueError
        If a stage or the validation frames are missing.
    """
    folder, out = Path(folder), Path(out)
    stages = {
        stage: load_training(folder / stage / "last.safetensors") for stage in ("frame", "tool", "window", "closeup")
    }
    frames = list(validation_frames(data))
    if not frames:
        raise FileNotFoundError(f"{data}: no validation shard; make some with `python3 -m lib train generate`.")
    opened = [Recording.open(path) for path in recordings]
    typical = [
        frame
        for recording in opened
        for frame in labelled_frames(recording, every=max(1, 2 * len(recording.frames) // _IMAGES))
    ]
    detector = Detector(
        stages["frame"].network,
        REDUCTION,
        window_network=stages["window"].network,
        tool_network=stages["tool"].network,
        tool_reduction=TOOL_REDUCTION,
        mirror=True,
        closeup_network=stages["closeup"].network,
    )
    held_out = evaluate(calibrate(detector, frames[::2] + typical), frames[1::2])
    detector = calibrate(detector, frames + typical)
    keys = ("data", "images", "commit", "steps", "seconds", "processes", "machine", "config", "metrics", "before")
    provenance = {
        "trained_on": "simulated frames only (lib.simulator.population); no eye or tool of a shipped recording",
        "commit": commit_id(),
        "machine": machine(),
        "stages": {name: {key: training.provenance.get(key) for key in keys} for name, training in stages.items()},
        "validation_frames": len(frames),
        "recorded_frames": len(typical),
        "recordings": len(opened),
        "notes": list(notes),
        "metrics": held_out.scores.as_dict()
        | {
            "confidence_calibration_error": held_out.confidence_error,
            "detection": held_out.detection(),
            "by_visibility": {
                k: {"labels": v.labels, "median_px": v.median_px} for k, v in held_out.by_visibility().items()
            },
            "by_landmark_median_px": {k: v.median_px for k, v in held_out.by_landmark().items()},
        },
    }
    provenance = json.loads(json.dumps(provenance, default=float))
    detector = replace(detector, metadata=provenance)
    out.parent.mkdir(parents=True, exist_ok=True)
    detector.save(out)
    out.with_name("README.md").write_text(card(detector, out), encoding="utf-8")
    return detector


def _history(provenance: dict) -> list[dict]:
    """A training and those it was fine-tuned from, the first one first."""
    before = provenance.get("before")
    return [*(_history(before) if before else []), provenance]


def _preset(config: dict) -> str:
    """The preset whose optimiser and schedule a training had."""
    return next(
        (k for k, p in PRESETS.items() if (p.optimiser, p.schedule) == (config["optimiser"], config["schedule"])), ""
    )


def _steps(training: dict) -> str:
    batch, processes = training["config"]["batch_size"], training.get("processes") or 1
    return f"{training['steps']} x {batch}" + (f" x {processes}" if processes > 1 else "")


def _each(values: Iterable[object]) -> str:
    """In their order, one that comes again next said once."""
    return " then ".join(str(value) for value, _ in groupby(values))


def _network(config: dict) -> str:
    if "stacks" in config:
        return "hourglass, {stacks} x {features} features".format(**config)
    return "offset network, {features} features".format(**config)


def card(detector: Detector, path: Path) -> str:
    """The Markdown card of a weights file, computed from its metadata."""
    p = detector.metadata
    m = p["metrics"]
    lines = [
        f"# {path.name}",
        "",
        "Weights of the landmark detector: base, tip_1 and tip_2 of the forceps in microscope images.",
        f"Trained on {p['trained_on']}.",
        "",
        "| | whole frame | tool | windows | closeups |",
        "|---|---|---|---|---|",
    ]

    def row(name: str, value) -> None:
        lines.append("| " + " | ".join([name, *(str(value(stage)) for stage in p["stages"].values())]) + " |")

    row("network", lambda s: _network(s["config"]["network"]))
    row("training images", lambda s: _each(t["images"] for t in _history(s)))
    row(
        "preset, optimiser",
        lambda s: f"{_preset(s['config'])}, {s['config']['optimiser']}, {s['config']['precision']}",
    )
    row("steps x batch x processes", lambda s: " then ".join(map(_steps, _history(s))))
    row(
        "position loss, per px",
        lambda s: _each(f"{t['config'].get('position_weight_per_px', 0):g}" for t in _history(s)),
    )
    row(
        "hours x processes",
        lambda s: f"{sum(t['seconds'] * (t.get('processes') or 1) for t in _history(s)) / 3600:.2f}",
    )
    row("data fingerprint", lambda s: _each(f"`{t['data']}`" for t in _history(s)))
    row("commit", lambda s: _each(f"`{t['commit']}`" for t in _history(s)))
    lines += [
        "",
        (
            f"The first stage sees the frame at 1/{detector.reduction} of its resolution, the second a window of "
            f"{detector.window_px} px at 1/{detector.tool_reduction} round the tool, the third windows of as many pixels "
            "at full resolution round each landmark"
            + (", and their mirror images, of which it takes the mean, the last " if detector.mirror else ", the last ")
            + f"closeups of {detector.closeup_network.config.size_px} px, "
            f"the base at {CLOSEUP_ZOOM[0]:g} of full resolution, the tips at {CLOSEUP_ZOOM[1]:g}. "
            "Each is trained on what it sees: the first two on reduced frames, the others on crops."
        ),
        "Assembled and measured on: {processor}, {cores} cores, {gpu}.".format(
            **p["machine"] | {"gpu": p["machine"]["gpu"] or "no GPU"}
        ),
        f"File: {path.stat().st_size / 1e6:.1f} MB, safetensors; configuration, calibration and this card's figures inside.",
        "",
        *(
            [
                f"Covariance and confidence are fitted on the validation frames and {p['recorded_frames']} frames of "
                f"{p['recordings']} simulated recordings, each with an eye and a tool of its own.",
                "",
            ]
            if p.get("recordings")
            else []
        ),
        f"Held-out simulated full-HD frames ({p['validation_frames'] // 2}, not trained on; these figures are of a "
        "calibration by the other half, the file's own is by both):",
        "",
        "| figure | value |",
        "|---|---|",
        f"| PCK@0.01 / 0.05 / 0.10 | {m['pck_0_01']:.1f} / {m['pck_0_05']:.1f} / {m['pck_0_10']:.1f} % |",
        f"| median, 95th percentile of the error | {m['median_px']:.2f} px, {m['p95_px']:.2f} px |",
        *(f"| median error of {k} | {v:.2f} px |" for k, v in m["by_landmark_median_px"].items()),
        *(
            f"| median error where {k}, of {v['labels']} labels | {v['median_px']:.2f} px |"
            for k, v in m["by_visibility"].items()
        ),
        f"| normalised squared error of errors below 20 px (2 is right) | {m['nees']:.2f} |",
        f"| 95 % ellipses hold, of errors below 20 px | {m['coverage_95']:.1f} % |",
        f"| confidence calibration error | {m['confidence_calibration_error']:.3f} |",
        *(
            f'| "{name.replace("_", " ")}" said (confidence above 0.5): precision, recall | '
            f"{m['detection'][name + '_precision']:.1f} %, {m['detection'][name + '_recall']:.1f} % |"
            for name in ("in_view", "visible")
        ),
        f"| missed, gross (above 20 px), of labels | {m['missed']}, {m['gross']}, {m['labels']} |",
        "",
        "Made by `python3 -m lib train generate`, `train frame`, `train tool`, `train window` and `train closeup`, each step "
        "above from the one before (`--initial`), and `train assemble`"
        + (", its `--recordings` by `python3 -m lib simulate`." if p.get("recordings") else "."),
        "",
    ]
    if p["notes"]:
        lines += [*(f"- {note}" for note in p["notes"]), ""]
    return "\n".join(lines)
