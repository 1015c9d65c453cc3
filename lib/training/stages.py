"""The detector's stages: training data and configuration, fine-tuning on labelled frames, and assembly to a detector."""

import json
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jinja2 import Environment, FileSystemLoader
from tqdm.auto import tqdm

from lib.files import write_text
from lib.landmarks import Detector
from lib.landmarks.detector import CLOSE
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.network import HourglassConfig, Network, OffsetConfig
from lib.parallel import cores, quick_turns, single_threaded_torch
from lib.provenance import commit_id, machine
from lib.recordings import Recording
from lib.simulator.population import VALIDATION_TEXTURE_SEEDS, sample
from lib.training.augmentation import AUGMENTATIONS
from lib.training.drawings import drawn_ground
from lib.training.error_models import fit_error_models
from lib.training.evaluation import evaluate
from lib.training.loop import PRESETS, Training, TrainingConfig, load_training, train
from lib.training.samples import LabelledImage, Mixed, Samples, Source, labelled_frames, labelled_images
from lib.training.shards import validation_images
from lib.training.sources import FRAME_PX, CloseupSource, FrameSource, ToolSource

#: The stages that are trained, in the order of their use, and the number of channels of the shipped networks.
STAGES = {"frame": 32, "tool": 48, "closeup": 32}
#: Standard deviation of a label, as a share of the tool's length, at which its weight in a stage's training is one half.
LABEL_SD = {"frame": 0.1, "tool": 0.04, "closeup": 0.02}
#: Fine-tuning beside simulated frames: share of the draws that are labelled frames, and share of these with a changed look.
_OWN_SHARE, _OWN_DISGUISE = 0.75, 0.2
_RATES = {"frame": 5e-4, "tool": 1e-3, "closeup": 5e-4}  # chosen on two simulated recordings of the validation families
_SOURCES = {"frame": FrameSource, "tool": ToolSource, "closeup": CloseupSource}


def stage_config(stage: str, *, preset: str = "best", features: int | None = None) -> TrainingConfig:
    """The configuration with which a stage of the shipped detector is trained.

    >>> stage_config("tool").network.features
    48
    """
    config, features = PRESETS[preset], features or STAGES[stage]
    if stage == "closeup":
        config = replace(config, augmentation=AUGMENTATIONS["closeups"])
        return replace(config, network=OffsetConfig(features), batch_size=64, clip=2.0)
    config = replace(config, augmentation=AUGMENTATIONS["none"], ema=0.998)  # the sources augment what they draw
    if stage == "frame":
        return replace(config, network=HourglassConfig(features, depth=3, growth=1.75), batch_size=16)
    return replace(config, network=HourglassConfig(features, growth=1.4))


def stage_data(stage: str, folder: str | Path) -> tuple[Source, Samples]:
    """Training data and validation samples of a stage, from a folder of shards."""
    return _SOURCES[stage].load(folder), _still(stage, validation_images(folder))


def _still(stage: str, images: Iterable[LabelledImage]) -> Samples:
    """The inputs of a stage for the held-out images with a landmark in view; the others have nothing to measure."""
    if not (shown := [one for one in images if (np.isfinite(one.u).all(1) & (one.visibility == 2)).any()]):
        raise ValueError(f"{stage}: no held-out image shows a landmark; label some, or `python3 -m lib train generate`.")
    return Samples.drawn(_SOURCES[stage].of(shown, still=True))


@quick_turns()
def finetune(
    detector: Detector, images: Sequence[LabelledImage], held_out: Sequence[LabelledImage], folder: str | Path, *,
    simulated: str | Path | Sequence[LabelledImage] | None = None, steps: int = 300, minutes: float | None = None,
    seed: int = 0, progress: bool | Callable[[str, float], None] = True,
) -> Detector:  # fmt: skip
    """Train all stages of a detector further on labelled frames, then adjust its error models to held-out ones.

    Args:
        images, held_out: Images of any size.  Consecutive frames are alike, so hold out whole recordings, or the end of one.
            Images without a labelled base and a labelled tip are left out.  A label has weight 1/2 if its standard deviation
            is `LABEL_SD` of the tool's length.
        folder: Where the checkpoints are written; the same call continues from them.
        simulated: Folder of `generate`'s shards.  A quarter of the draws then comes from there, so that the networks do not
            forget tools and eyes that the labelled frames do not show; its held-out frames are added to `held_out` for the
            error models.  Or full frames, of which every third is for the error models and the others are for training.
        steps, minutes: Number of steps of each stage; time limit for all of them, which they share.
        progress: True = show a bar for each stage.  A function is called with the stage and the share that is done.

    Raises ValueError if there is no usable image, or if fewer than 20 landmarks are found in the held-out images and the
    detector has no error models yet.
    """
    images, held_out = ([one for one in part if np.isfinite(tool_length_px(one.u))] for part in (images, held_out))
    for kind, part in (("training", images), ("validation", held_out)):
        if not part:
            raise ValueError(f"{kind} images: none has a labelled base and tip; label some.")
    relative_sd = np.stack([np.broadcast_to(one.sd_px, 3) / tool_length_px(one.u) for one in images])
    extra_held_out = validation_images(simulated) if isinstance(simulated, str | Path) else (simulated or ())[::3]
    began, names, stopped = time.perf_counter(), list(detector.networks), threading.Event()
    bars = {stage: tqdm(total=1.0, desc=stage, disable=progress is not True, bar_format="{l_bar}{bar}") for stage in names}

    def report(stage: str, part: float) -> None:
        if stopped.is_set():
            raise InterruptedError(f"{stage}: the training was interrupted.")
        bars[stage].update(part - bars[stage].n)
        if callable(progress):
            progress(stage, part)

    def trained(lane: list[str]) -> dict[str, Network]:
        """Train the stages of a thread one after the other, each for the same time."""
        found = {}
        for number, stage in enumerate(lane):
            own = _SOURCES[stage].of(images, weight=1 / (1 + (relative_sd / LABEL_SD[stage]) ** 2))
            source: Source = replace(own, disguise=_OWN_DISGUISE)
            if isinstance(simulated, str | Path):
                source = Mixed(source, _SOURCES[stage].load(simulated), _OWN_SHARE)
            elif simulated:
                source = Mixed(source, _SOURCES[stage].of([one for i, one in enumerate(simulated) if i % 3]), _OWN_SHARE)
            config = replace(stage_config(stage), network=detector.networks[stage].config, steps=steps, seed=seed)
            config = replace(config, batch_size=min(config.batch_size, 24), validate_every=max(1, steps // 3))
            config = replace(config, learning_rate=_RATES[stage], ema=0.995)
            start = Training(detector.networks[stage], [], {"shipped": detector.metadata.get("commit")})
            left = None if minutes is None else (60 * minutes - (time.perf_counter() - began)) / (len(lane) - number)
            rest = {"initial": start, "max_seconds": left, "progress": partial(report, stage)}
            found[f"{stage}_network"] = train(config, source, _still(stage, held_out), Path(folder) / stage, **rest).network
        return found

    # More threads in torch make small steps hardly faster, on a busy machine far slower.  One stage keeps a GPU busy.
    threads = 1 if torch.cuda.is_available() else min(cores(), len(names))
    networks = {}
    lanes = [names[first::threads] for first in range(threads)]  # two threads: frame and closeup beside tool
    with single_threaded_torch(), ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            for found in as_completed([pool.submit(trained, lane) for lane in lanes]):
                networks |= found.result()
        except BaseException:
            stopped.set()
            raise
    added = {"finetuned": {"images": len(images), "held_out": len(held_out), "commit": commit_id()}}
    added["trained_on"] = f"{detector.metadata.get('trained_on', 'images that nobody noted')}; then on labelled frames"
    tuned = replace(detector, **networks, metadata=detector.metadata | added)
    tuned = fit_error_models(tuned, [*held_out, *extra_held_out], anew=False, progress=progress is True)
    old = {stage: detector.error_models[stage] for stage in CLOSE if stage in detector.error_models}
    if detector.closeup_network is None or not old:
        return tuned
    # Held-out images decide whether the short training improved the closeups.  The smallest errors weigh as much as all.
    choices = tuned, replace(tuned, closeup_network=detector.closeup_network, error_models=tuned.error_models | old)
    scores = {choice: evaluate(choice, held_out).scores for choice in choices}
    return max(scores, key=lambda choice: scores[choice].auc + scores[choice].pck_0_01)


def training_of(detector: Detector, stage: str) -> Training:
    """The network of a detector's stage, as a training with the provenance from the detector's metadata."""
    if stage not in detector.networks:
        raise ValueError(f"initial: has no {stage} stage; its stages are {', '.join(detector.networks)}.")
    return Training(detector.networks[stage], [], detector.metadata.get("stages", {}).get(stage, {}))


def assemble(
    folder: str | Path, data: str | Path, out: str | Path, recordings: Sequence[Path] = (), notes: Sequence[str] = (),
    initial: Detector | None = None,
) -> Detector:  # fmt: skip
    """Join the stages of a training folder, fit their error models, write the weights file `out` and its card.

    The error models are fitted on half of the held-out scenes, whose families no training saw, on drawn grounds without a
    tool, and on labelled `recordings`, if any.  Those of the closeups are also fitted on half as many images of the reference
    rig, since their bias must suit familiar tools, too.  The card's numbers come from the other half of the scenes.  `notes`
    are lines for the card.  A missing stage is taken from `initial`.  Raises FileNotFoundError without it or without shards.
    """
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    trained = {stage: Path(folder) / stage / "last.safetensors" for stage in STAGES}
    stages = {k: load_training(p) if p.exists() or not initial else training_of(initial, k) for k, p in trained.items()}
    if not (frames := list(validation_images(data))):
        raise FileNotFoundError(f"{data}: no shard held_out_*.npz; make some with `python3 -m lib train generate`.")
    rng = np.random.default_rng(len(frames))
    near = {"population": "near", "textures": VALIDATION_TEXTURE_SEEDS}
    grounds = (drawn_ground(one.image, rng) for one in frames[::8])
    bare = [LabelledImage(f"bare {i}", image, np.full((3, 2), np.nan), np.zeros(3)) for i, image in enumerate(grounds)]
    near_by = [LabelledImage(f"near {i}", *sample(rng, **near)) for i in range(len(frames) // 4)]
    opened = map(Recording.open, recordings)  # the images of about 8 labelled frames of each, spread over it
    typical = [one for own in opened for one in labelled_images(own, every=max(1, len(labelled_frames(own)) // 8))]
    networks = {f"{stage}_network": training.network.halved() for stage, training in stages.items()}
    detector = Detector(**networks, frame_px=FRAME_PX[0])
    detector = fit_error_models(detector, frames[::2] + bare + typical, for_closeups=near_by, progress=True)
    held_out = evaluate(detector, frames[1::2], progress=True)
    keys = "data images commit steps seconds processes precision machine config metrics before".split()
    simulated = "simulated frames and flat drawings only (lib.simulator.population, lib.training.drawings); "
    simulated += "no eye or tool of a shipped recording"
    provenance = {
        "trained_on": initial.metadata.get("trained_on", simulated) if initial else simulated,
        "commit": commit_id(), "machine": machine(), "notes": list(notes),
        "stages": {name: {key: training.provenance.get(key) for key in keys} for name, training in stages.items()},
        "validation_frames": len(frames), "bare_frames": len(bare), "near_frames": len(near_by),
        "recorded_frames": len(typical), "recordings": len(recordings),
        "metrics": asdict(held_out.scores) | {
            "confidence_calibration_error": held_out.confidence_error, "detection": held_out.detection(),
            "by_visibility": {k: {"labels": v.labels, "median_px": v.median_px} for k, v in held_out.by_visibility().items()},
            "by_landmark_median_px": {k: v.median_px for k, v in held_out.by_landmark().items()},
        },
    }  # fmt: skip
    detector = replace(detector, metadata=json.loads(json.dumps(provenance, default=float)))
    detector.save(out)
    write_text(out.with_name("README.md") if out.stem == "default" else out.with_suffix(".md"), card(detector, out))
    return detector


def card(detector: Detector, path: Path) -> str:
    """The model card (Markdown) of a weights file, from its metadata."""
    trainings = []
    for stage, one in reversed(detector.metadata["stages"].items()):
        while one:  # from the last training to the first
            trainings.append((stage, one))
            one = one.get("before")
    here = Environment(loader=FileSystemLoader(Path(__file__).parent), trim_blocks=True)
    names = {"p": detector.metadata, "trainings": trainings[::-1], "name": path.name, "megabytes": path.stat().st_size / 1e6}
    return here.get_template("card.md").render(names)
