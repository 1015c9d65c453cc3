"""Long studies of the detector: ``python3 -m notebooks.studies.detector_studies NAME``; numbers go to data/results.

Every training keeps its checkpoints in data/cache/studies, so a study that was stopped goes on where it was, and one that
is complete is only evaluated anew.  Its budget (what a training may cost) is the same for all that it compares.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
import time
import timeit
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch

from lib import paths
from lib.correspondences import LANDMARKS
from lib.geometry import cell_from_image
from lib.landmarks import Detector, Landmarks
from lib.landmarks.engines import LastOutput, OpenVinoNetwork
from lib.landmarks.network import ABLATION, HourglassConfig, StackedHourglass
from lib.provenance import Provenance, read_records, write_record
from lib.recordings import Recording, import_retinal_microsurgery
from lib.training.augmentation import AUGMENTATIONS
from lib.training.evaluation import TRACKED_SHIFT_PX, Evaluation, evaluate, focus_distance_mm, labelled_frames
from lib.training.loop import PRESETS, Samples, Source, Training, TrainingConfig, train, validate
from lib.training.samples import TOOL, TOOL_REDUCTION, WindowSource, crop_frames, frame_samples, validation_frames
from notebooks.studies import real
from notebooks.studies.resolution import RESOLUTIONS, ReducedDetector, resolution_windows

__all__ = ["STUDIES", "main", "read_results", "summary"]

#: Thresholds of recorded PCK curves, parts of the tool's length.
CURVE = (0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2)


@dataclass(frozen=True)
class Options:
    """What the command line decides.

    Attributes
    ----------
    data:
        Folder of training and validation shards (`lib.training.samples`).
    test:
        Folder of simulated sequences; its ``test_*`` recordings are the test where there are any, else the validation
        shards' second half.
    folder:
        Keeps the checkpoints.
    shards:
        So many training shards of 16 frames are used.
    """

    data: Path
    test: Path
    folder: Path
    seeds: int
    steps: int
    batch: int
    features: int
    shards: int
    progress: bool = True
    #: Called with a study's result whenever it has grown.
    record: Callable[[dict], None] = field(default=lambda _: None)
    #: What each training took, all its sittings together: the study itself may only have evaluated it anew.
    trained_s: dict[str, float] = field(default_factory=dict)

    @property
    def budget(self) -> dict[str, object]:
        return {
            "steps": self.steps,
            "batch": self.batch,
            "features": self.features,
            "training_frames": 16 * self.shards,
            "optimiser": "adamw 2e-3, cosine, average of weights 0.99, bf16",
            "seeds": self.seeds,
        }

    def config(self, network: HourglassConfig, seed: int) -> TrainingConfig:
        return replace(
            PRESETS["best"],
            network=network,
            augmentation=AUGMENTATIONS["none"],  # rotation and zoom are drawn with the windows, as in the paper
            steps=self.steps,
            batch_size=self.batch,
            ema=0.99,
            validate_every=max(1, self.steps // 2),
            seed=seed,
        )


def read_results(path: Path | None = None) -> dict[str, dict]:
    """Recorded results of all studies that have been run, by name; empty where there are none."""
    return read_records(path or paths.RESULTS / "detector.json")


# --- statistics ----------------------------------------------------------------------------------------------------


def summary(values: Sequence[float]) -> dict[str, object]:
    """Mean over seeds, its standard error (NaN for one seed), and the values."""
    v = np.asarray(values, dtype=float)
    error = v.std(ddof=1) / np.sqrt(len(v)) if len(v) > 1 else np.nan
    return {"mean": float(v.mean()), "standard_error": float(error), "per_seed": v.tolist()}


def verdicts(rows: Mapping[str, Mapping[str, object]]) -> dict[str, str]:
    """Each row against the one before it: "better", "worse", or "tie" below two standard errors of the difference."""
    names, result = list(rows), {}
    for before, name in pairwise(names):
        a, b = rows[before], rows[name]
        difference = b["mean"] - a["mean"]
        error = np.hypot(a["standard_error"], b["standard_error"])
        if not np.isfinite(error):
            result[f"{before} -> {name}"] = "one seed: no statement"
        else:
            result[f"{before} -> {name}"] = (
                "tie" if abs(difference) < 2 * error else "better" if difference > 0 else "worse"
            )
    return result


# --- data ----------------------------------------------------------------------------------------------------------


def test_frames(options: Options, every: int = 2) -> tuple[str, list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]]:
    """What the test is, in words, and its full-HD frames: name, image, u, visibility."""
    recordings = sorted(options.test.glob("test_*"))
    if recordings:
        frames = [
            (f"{folder.name} {name}", *rest)
            for folder in recordings
            for name, *rest in labelled_frames(Recording.open(folder), every=every)
        ]
        return f"{len(frames)} full-HD images of {len(recordings)} sequences, eyes and tools never trained on", frames
    frames = list(validation_frames(options.data))[1::2]
    return f"{len(frames)} simulated full-HD images, textures never trained on", frames


def _tool_windows(frames: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray]], template: WindowSource) -> Samples:
    """One window round the tool of each frame, displaced, turned and zoomed at random as in training."""
    small, labels, visible = [], [], []
    for _, image, u, visibility in frames:
        if np.isfinite(u).all():
            size = (image.shape[1] // TOOL_REDUCTION, image.shape[0] // TOOL_REDUCTION)
            small.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
            labels.append(cell_from_image(u, TOOL_REDUCTION))
            visible.append(visibility)
    source = replace(
        template,
        crops=np.stack(small),
        u=np.stack(labels),
        visibility=np.stack(visible),
        landmark=np.full(len(small), TOOL),
    )
    return Samples.drawn(source, seed=1)


def _trained(
    options: Options,
    name: str,
    seed: int,
    network: HourglassConfig,
    source: Source,
    validation: Samples,
    initial: Training | None = None,
    **changes: object,
) -> Training:
    """The training of `name` with this seed, from its checkpoint as far as there is one."""
    config = replace(options.config(network, seed), **changes)
    if options.progress:
        print(f"{name}, seed {seed}", flush=True)
    folder = options.folder / name / f"seed{seed}"
    done = train(config, source, validation, folder, initial=initial, progress=options.progress)
    options.trained_s[f"{name}/seed{seed}"] = done.provenance["seconds"]
    return done


# --- the studies ---------------------------------------------------------------------------------------------------


def ablation(options: Options) -> None:
    """The five columns of the paper's table, on windows round the tool at a fifth of full HD."""
    turned = {"shift_px": 8.0, "turn_rad": np.radians(15.0), "zoom": (0.75, 1.25)}
    source = replace(WindowSource.load_tools(options.data, shards=options.shards), **turned)
    held_out = replace(WindowSource.load_tools(options.data, validation=True), **turned)
    validation = Samples.drawn(held_out)
    what, frames = test_frames(options)
    test = _tool_windows(frames, held_out)
    figures: dict[str, dict[str, list[float]]] = {name: {} for name in ABLATION}
    seconds: dict[str, list[float]] = {name: [] for name in ABLATION}
    for seed in range(options.seeds):
        for name, columns in ABLATION.items():
            # Halvings: the tool is 60 px long here, not 300, so 3 make it as many cells of the bottleneck as in the paper.
            network = HourglassConfig(options.features, depth=3, **columns)
            done = _trained(options, f"ablation/{name.replace('+ ', '')}", seed, network, source, validation)
            scores = validate(done.network, test, options.config(network, seed))
            for key in ("pck_0.05", "pck_0.10", "median_px"):
                figures[name].setdefault(key, []).append(scores[key])
            seconds[name].append(done.provenance["seconds"])
        rows = {name: {key: summary(v) for key, v in values.items()} for name, values in figures.items()}
        options.record(
            {
                "what": "windows of 128 px round the tool at 1/5 of full HD, each displaced by 8 px and turned by 15 "
                "degrees (standard deviations, three times that in a tenth of them), zoom 0.75 to 1.25",
                "test": what,
                "columns": rows,
                "verdicts": verdicts({name: row["pck_0.05"] for name, row in rows.items()}),
                "paper_pck_0.05": dict(zip(ABLATION, (8.4, 75.1, 95.2, 99.6, 99.7), strict=True)),
                "seconds": {name: round(float(np.mean(s))) for name, s in seconds.items()},
            }
        )


def _finder() -> Detector:
    return replace(Detector.load(), window_network=None, closeup_network=None)


def _figures(e: Evaluation) -> dict[str, float]:
    s = e.scores
    return {
        "pck_0.01": s.pck_0_01,
        "pck_0.05": s.pck_0_05,
        "pck_0.10": s.pck_0_10,
        "median_px": s.median_px,
        "p95_px": s.p95_px,
        "nees": s.nees,
        "coverage_95": s.coverage_95,
        "confidence_error": e.confidence_error,
        "missed": s.missed,
        "labels": s.labels,
    }


class _FullHd:
    """Validation and test frames with what the finder says of them: the same for every network of the windows."""

    def __init__(self, options: Options):
        finder = _finder()
        self.finder = finder
        fit_on = list(validation_frames(options.data))[::2]
        self.what, frames = test_frames(options)
        self.fit = evaluate(finder, fit_on), np.stack([f[1] for f in fit_on]), np.stack([f[2] for f in fit_on])
        self.test, self.images = evaluate(finder, frames), [f[1] for f in frames]

    def judge(self, training: Training, name: str, folder: Path) -> Evaluation:
        """Calibrate the network on validation frames, and evaluate it on the test's."""
        detector = ReducedDetector(self.finder, training.network, RESOLUTIONS[name])
        fit, images, u = self.fit
        detector = detector.calibrated(images, fit.landmarks, u, fit.visibility)
        detector.save_calibration(folder)
        parts = [detector.refine(image[None], self.test.landmarks[i : i + 1]) for i, image in enumerate(self.images)]
        return replace(self.test, landmarks=Landmarks.join(parts))


def _network(options: Options) -> HourglassConfig:
    return HourglassConfig(options.features, **ABLATION["+ residual"])


def resolution(options: Options) -> None:
    """The windows' stage at the paper's four resolutions, on full-HD frames."""
    crops, held_out = (
        WindowSource.load(options.data, shards=options.shards),
        WindowSource.load(options.data, validation=True),
    )
    frames = _FullHd(options)
    figures: dict[str, dict[str, list[float]]] = {name: {} for name in RESOLUTIONS}
    curves: dict[str, list[np.ndarray]] = {name: [] for name in RESOLUTIONS}
    seconds: dict[str, list[float]] = {name: [] for name in RESOLUTIONS}
    for seed in range(options.seeds):
        for name, size in RESOLUTIONS.items():
            source = resolution_windows(crops, size)
            validation = Samples.drawn(resolution_windows(held_out, size))
            done = _trained(options, f"resolution/{name}", seed, _network(options), source, validation)
            judged = frames.judge(done, name, options.folder / "resolution" / name / f"seed{seed}")
            for key, value in _figures(judged).items():
                figures[name].setdefault(key, []).append(value)
            curves[name].append(judged.curve(np.array(CURVE)))
            seconds[name].append(done.provenance["seconds"])
        rows = {name: {key: summary(v) for key, v in values.items()} for name, values in figures.items()}
        options.record(
            {
                "what": "the frame shrunk to the resolution, windows of 128 full-HD px round each landmark; the shipped "
                "detector's first two stages, the same for all, place them",
                "test": frames.what,
                "finder_pck_0.10": frames.test.scores.pck_0_10,
                "resolutions": rows,
                "verdicts": verdicts({name: rows[name]["pck_0.01"] for name in reversed(rows)}),
                "thresholds": list(CURVE),
                "curves": {name: np.mean(c, axis=0).tolist() for name, c in curves.items()},
                "seconds": {name: round(float(np.mean(s))) for name, s in seconds.items()},
            }
        )


def label_noise(options: Options, sigma_px: float = 1.0) -> None:
    """Annotations off by 1 px (standard deviation per coordinate) in training, against exact ones; the test is exact."""
    crops, held_out = (
        WindowSource.load(options.data, shards=options.shards),
        WindowSource.load(options.data, validation=True),
    )
    frames = _FullHd(options)
    validation = Samples.drawn(resolution_windows(held_out, RESOLUTIONS["1080p"]))
    figures: dict[str, dict[str, list[float]]] = {"exact": {}, "noisy": {}}
    for seed in range(options.seeds):
        for name, folder, source in (
            ("exact", "resolution/1080p", crops),
            ("noisy", "label_noise/noisy", _noisy(crops, options, sigma_px)),
        ):
            source = resolution_windows(source, RESOLUTIONS["1080p"])
            done = _trained(options, folder, seed, _network(options), source, validation)
            judged = frames.judge(done, "1080p", options.folder / folder / f"seed{seed}")
            for key, value in _figures(judged).items():
                figures[name].setdefault(key, []).append(value)
        rows = {name: {key: summary(v) for key, v in values.items()} for name, values in figures.items()}
        cost = np.array(figures["noisy"]["median_px"]) - np.array(figures["exact"]["median_px"])
        options.record(
            {
                "what": f"the resolution study's 1080p network, labels off by {sigma_px:g} px per coordinate in training",
                "test": frames.what,
                "labels": rows,
                "median_cost_px": summary(cost),
            }
        )


def _noisy(source: WindowSource, options: Options, sigma_px: float) -> WindowSource:
    """One click a landmark and frame: the crops of a frame share its errors."""
    frame, landmark = crop_frames(options.data, options.shards)
    if not np.array_equal(landmark, source.landmark):
        raise ValueError(f"{options.data}: crops and frames of the shards do not belong together; generate them again.")
    clicks = np.random.default_rng(99).normal(0, sigma_px, (frame.max() + 1, 3, 2))
    return replace(source, u=source.u + clicks[frame])


def few_labels(options: Options, counts: Sequence[int] = (10, 30, 100, 300, 750)) -> None:
    """PCK against the number of annotated frames: the tool stage fine-tuned from the shipped weights, and from scratch.

    The shipped weights were trained on these very shards, so only the curve from scratch says what so many labels are worth.
    """
    shipped = Detector.load()
    source = WindowSource.load_tools(options.data, shards=options.shards)
    held_out = WindowSource.load_tools(options.data, validation=True)
    validation = Samples.drawn(held_out)
    what, frames = test_frames(options)
    test = _tool_windows(frames, held_out)
    network = shipped.tool_network.config
    initial = Training(shipped.tool_network, [], {"shipped": shipped.metadata.get("commit")})
    figures: dict[str, dict[str, dict[str, list[float]]]] = {"fine-tuned": {}, "from scratch": {}}
    none = validate(shipped.tool_network, test, options.config(network, 0))
    for seed in range(options.seeds):
        for count in counts:
            chosen = np.random.default_rng([5, seed]).permutation(len(source))[:count]
            part = replace(
                source, **{key: getattr(source, key)[chosen] for key in ("crops", "u", "visibility", "landmark")}
            )
            for name in figures:
                start = initial if name == "fine-tuned" else None
                rate = 3e-4 if start else 2e-3
                done = _trained(
                    options, f"few_labels/{name.replace(' ', '_')}_{count}", seed, network, part, validation, start,
                    learning_rate=rate, augmentation=AUGMENTATIONS["windows"],
                )  # fmt: skip
                scores = validate(done.network, test, options.config(network, seed))
                row = figures[name].setdefault(str(count), {})
                for key in ("pck_0.05", "pck_0.10", "median_px"):
                    row.setdefault(key, []).append(scores[key])
        options.record(
            {
                "what": f"the tool stage ({network.stacks} x {network.features} features), windows at 1/5 of full HD; "
                "the shipped weights were trained on these very shards, so the fine-tuned curve is no test of transfer",
                "test": what,
                "budget": options.budget
                | {"features": network.features, "learning_rate": {"fine-tuned": 3e-4, "from scratch": 2e-3}},
                "no_label": {key: none[key] for key in ("pck_0.05", "pck_0.10", "median_px")},
                "frames": {
                    name: {n: {k: summary(v) for k, v in row.items()} for n, row in rows.items()}
                    for name, rows in figures.items()
                },
            }
        )


def real_frames(options: Options) -> None:
    """Real sequences: the finder fine-tuned on the first half of one, tested on its second half and on the other sequence;
    and the shipped detector, which has seen no real frame."""
    folder = paths.real_data("retinal_microsurgery")
    if folder is None:
        print(paths.missing_data_line("retinal_microsurgery"))
        return
    detector, simulated = Detector.load(), frame_samples(options.data)
    sequences = import_retinal_microsurgery(folder)
    config = real.real_config(options.steps, batch=options.batch)
    network = detector.frame_network.config
    thresholds = np.round(np.linspace(0.05, 0.5, 10), 3)
    budget = {
        "steps": options.steps,
        "batch": options.batch,
        "crop_px": real.CROP_PX,
        "features": network.features,
        "stacks": network.stacks,
        "real_frames": {s.name: len(s) // 2 for s in sequences},
        "simulated_frames": len(simulated),
        "simulated_share": real.Mixed.share,
        "optimiser": f"adamw {config.learning_rate:g}, cosine, average of weights {config.ema:g}, bf16",
        "augmentation": asdict(config.augmentation),
        "seeds": options.seeds,
    }
    kept: dict[str, list[Evaluation]] = {}

    def keep(name: str, e: Evaluation) -> None:
        kept.setdefault(name, []).append(e)
        options.record(
            {
                "what": "the first stage of the shipped detector fine-tuned on crops of the first half of a sequence and, "
                "as many, of simulated frames; and the whole shipped detector, which saw no real frame; means over seeds",
                "thresholds": thresholds.tolist(),
                "results": {name: _real_figures(of_seeds, thresholds) for name, of_seeds in kept.items()},
                "labels_of_the_second_half_hit_by_their_neighbours": {
                    s.name: real.label_repeatability(s) for s in sequences
                },
                "weights": detector.metadata.get("commit"),
                "budget": budget,
            }
        )

    for seed in range(options.seeds):
        for sequence in sequences:
            done = real.train_on_first_half(
                sequence, detector, simulated, replace(config, seed=seed),
                folder=options.folder / "real_frames" / sequence.name / f"seed{seed}", progress=options.progress,
            )  # fmt: skip
            options.trained_s[f"{sequence.name}/seed{seed}"] = done.provenance["seconds"]
            tuned = real.finder_alone(detector, done)
            keep(f"{sequence.name}: first half to second", real.evaluate_on_sequence(tuned, sequence, second_half=True))
            for other in sequences:
                if other is not sequence:
                    keep(f"{sequence.name}: first half to {other.name}", real.evaluate_on_sequence(tuned, other))
    for sequence in sequences:
        keep(f"{sequence.name}: simulated frames only", real.simulated_to_real(detector, sequence, every=4))


def _real_figures(of_seeds: Sequence[Evaluation], thresholds: np.ndarray) -> dict[str, object]:
    """Means over seeds; the frames and labels are the same."""
    first = of_seeds[0]
    within = np.stack([e.error_px <= 0.2 * e.length_px[:, None] for e in of_seeds])
    known = ~np.isnan(first.error_px)
    per_seed = [float(e.curve(np.array([0.2]))[0]) for e in of_seeds]
    return {
        "pck_0.20": float(np.mean(per_seed)),
        "pck_0.20_per_seed": per_seed,
        "pck_0.20_by_landmark": {
            landmark: 100 * float(within[:, known[:, k], k].mean()) for k, landmark in enumerate(LANDMARKS)
        },
        "median_px": float(np.mean([e.scores.median_px for e in of_seeds])),
        "median_tool_px": float(np.nanmedian(first.length_px)),
        "frames": len(first.names),
        "curve": np.mean([e.curve(thresholds) for e in of_seeds], axis=0).tolist(),
    }


def shipped(options: Options) -> None:
    """The shipped weights on every test sequence and the shipped recording: whole frames, and closeups as when tracking."""
    detector = Detector.load()
    recordings = [Recording.open(folder) for folder in sorted(options.test.glob("test_*"))]
    recordings.append(Recording.open(paths.DATA / "open_sky_eye"))
    parts: list[Evaluation] = []
    tracked: list[Evaluation] = []
    rng = np.random.default_rng(0)
    for recording in recordings:
        frames = list(labelled_frames(recording))
        parts.append(evaluate(detector, frames, progress=options.progress))
        found = parts[-1].landmarks
        before = replace(found, u=found.u + rng.normal(0, TRACKED_SHIFT_PX / np.sqrt(2), (len(frames), 1, 2)))
        pieces = [detector.track(image[None], before[i : i + 1]) for i, (_, image, _, _) in enumerate(frames)]
        tracked.append(replace(parts[-1], landmarks=Landmarks.join(pieces)))
    whole, windows = _together(parts), _together(tracked)
    depth_mm = np.concatenate([focus_distance_mm(recording) for recording in recordings])
    options.record(
        {
            "what": "the shipped detector; tracking: closeups placed where the landmarks were found, the whole tool "
            f"displaced by {TRACKED_SHIFT_PX:g} px (root mean square: 2 mm/s at 25 Hz)",
            "test": f"{len(whole.names)} full-HD images of {len(recordings)} sequences, eyes and tools never trained on",
            "weights": detector.metadata.get("commit"),
            "whole_frames": _figures(whole) | {"auc": whole.scores.auc} | whole.detection(),
            "tracking": _figures(windows) | windows.detection(),
            "by_landmark": {name: asdict(s) for name, s in whole.by_landmark().items()},
            "by_distance_from_focus": {
                which: {name: asdict(s) for name, s in whole.by_depth(depth_mm, (0, 0.5, 1, 2, 4), k).items()}
                for which, k in (("base", [0]), ("tips", [1, 2]))
            },
            "by_sequence": {r.name: _figures(e) for r, e in zip(recordings, parts, strict=True)},
            "thresholds": list(CURVE),
            "curve": whole.curve(np.array(CURVE)).tolist(),
            "budget": {"images": len(whole.names)},
        }
    )


def _together(parts: Sequence[Evaluation]) -> Evaluation:
    """One evaluation of several."""
    u_true, visibility, length = (
        np.concatenate([getattr(e, name) for e in parts]) for name in ("u_true", "visibility", "length_px")
    )
    names = [name for e in parts for name in e.names]
    return Evaluation(Landmarks.join([e.landmarks for e in parts]), u_true, visibility, length, names)


def speed(options: Options, repeats: int = 20) -> None:
    """Stereo pairs a second, decoding included: the shipped detector on whole full-HD frames and while tracking, beside the
    paper's network at its four resolutions, one after the other on the same threads (``--threads``)."""
    detector, recording = Detector.load(), Recording.open(paths.SHIPPED_RECORDING)
    pair = np.stack([recording.frames[0].left, recording.frames[0].right])
    found = detector(pair)
    # Random weights: they do not change the time.
    papers = Detector(StackedHourglass(HourglassConfig(features=64, stacks=2)), method="paper")

    def rate(run: Callable[[], object], times: int) -> dict[str, float]:
        run()  # the first call warms up
        return {"pairs_per_second": 1 / float(np.median(timeit.repeat(run, number=1, repeat=times))), "repeats": times}

    rows = {
        "whole frames": rate(lambda: detector(pair), repeats),
        "tracking": rate(lambda: detector.track(pair, found), repeats),
    }
    for width, height in RESOLUTIONS.values():
        rows[f"paper's network, {width} x {height}"] = rate(partial(papers, pair[:, :height, :width]), 3)
    options.record(
        {
            "what": "a left and a right image of the shipped recording, from pixels to landmarks",
            "engine": detector.engine,
            "rows": rows,
            "budget": {},
        }
    )


def engines(options: Options, repeats: int = 20) -> None:
    """What runs the window stage fastest on this CPU: six windows, those of a stereo pair, in ms of wall and CPU time."""
    network = Detector.load(engine="torch").window_network
    images = torch.rand((6, 3, 128, 128), generator=torch.Generator().manual_seed(0))
    plain, nchw = LastOutput(network).eval(), images.contiguous()
    fused, nhwc = network.fused(), images.to(memory_format=torch.channels_last)

    def bfloat16() -> object:
        with torch.autocast("cpu", torch.bfloat16):
            return fused(nhwc)

    def compiled() -> Callable[[], object]:
        run = torch.compile(fused)
        return lambda: run(nhwc)

    def frozen() -> Callable[[], object]:
        run = torch.jit.freeze(torch.jit.trace(plain, nchw, check_trace=False))
        return lambda: run(nchw)

    def open_vino(precision: str) -> Callable[[], object]:
        run = OpenVinoNetwork(network, precision=precision)
        return lambda: run(nchw)

    def onnx_runtime() -> Callable[[], object]:
        import onnxruntime  # no part of the environment: measured where a user has it

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "window.onnx"
            torch.onnx.export(plain, (nchw,), str(path), dynamo=False, opset_version=18, input_names=["images"])
            settings = onnxruntime.SessionOptions()
            settings.intra_op_num_threads = torch.get_num_threads()
            session = onnxruntime.InferenceSession(str(path), settings, providers=["CPUExecutionProvider"])
        return lambda: session.run(None, {"images": nchw.numpy()})

    rows: dict[str, object] = {}
    for name, make in {
        "torch, float32": lambda: lambda: fused(nhwc),
        "torch, bfloat16": lambda: bfloat16,
        "torch.jit, float32": frozen,
        "torch.compile, float32": compiled,
        "ONNX Runtime, float32": onnx_runtime,
        "OpenVINO, float32": lambda: open_vino("f32"),
        "OpenVINO, bfloat16": lambda: open_vino("bf16"),
    }.items():
        try:
            with torch.inference_mode(), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run = make()
                for _ in range(3):
                    run()
                wall, cpu = [], time.process_time()
                for _ in range(repeats):
                    start = time.perf_counter()
                    run()
                    wall.append(time.perf_counter() - start)
                cpu = (time.process_time() - cpu) / repeats
            rows[name] = {"wall_ms": 1e3 * float(np.median(wall)), "cpu_ms": 1e3 * cpu}
        except Exception as error:  # an engine that is missing or broken here is a result too
            rows[name] = {"failed": f"{type(error).__name__}: {str(error).splitlines()[0][:120] if str(error) else ''}"}
    options.record({"threads": torch.get_num_threads(), "windows": 6, "engines": rows, "budget": {"repeats": repeats}})


STUDIES: dict[str, Callable[[Options], None]] = {
    f.__name__: f for f in (resolution, ablation, label_noise, few_labels, real_frames, shipped, speed, engines)
}
#: Steps of each training unless the command says otherwise: what fits 10 to 20 minutes of one idle core.
STEPS = {"resolution": 1000, "ablation": 800, "label_noise": 1000, "few_labels": 250, "real_frames": 1200}


def _command(parser: argparse.ArgumentParser, given: argparse.Namespace) -> str:
    """The command with every option that differs from its default."""
    words = ["python3", "-m", "notebooks.studies.detector_studies", given.study]
    for name, value in vars(given).items():
        if name != "study" and value != parser.get_default(name):
            words += [f"--{name}", paths.shown(value) if isinstance(value, Path) else str(value)]
    return shlex.join(words)


def main(argv: list[str] | None = None) -> int:
    """Run one study (or go on with it) and merge its figures into the results file after every seed."""
    parser = argparse.ArgumentParser(prog="python3 -m notebooks.studies.detector_studies", description=__doc__.split(";")[0])
    parser.add_argument("study", choices=list(STUDIES))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, help=f"of each training (default: {STEPS})")
    parser.add_argument("--batch", type=int, default=12)
    parser.add_argument("--features", type=int, default=32)
    parser.add_argument("--shards", type=int, default=80, help="training shards of 16 frames")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--data", type=Path, default=paths.CACHE / "landmarks")
    parser.add_argument("--test", type=Path, default=paths.CACHE / "dataset-0")
    parser.add_argument("--folder", type=Path, default=paths.CACHE / "studies")
    parser.add_argument("--out", type=Path, default=paths.RESULTS / "detector.json")
    a = parser.parse_args(argv)
    torch.set_num_threads(a.threads)
    steps = a.steps or STEPS.get(a.study, 0)
    provenance = Provenance(_command(parser, a))

    def record(result: dict) -> None:
        budget = result.pop("budget", options.budget)
        trainings = {"training_seconds": sum(options.trained_s.values())} if options.trained_s else {}
        write_record(a.out, a.study, result, provenance, budget=budget, torch_threads=a.threads, **trainings)

    options = Options(a.data, a.test, a.folder, a.seeds, steps, a.batch, a.features, a.shards, record=record)
    try:
        STUDIES[a.study](options)
    except KeyboardInterrupt:
        print("\nStopped; the same command goes on from the last checkpoint.", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
