"""``python3 -m lib train`` and ``python3 -m lib evaluate``."""

import argparse
import sys
from dataclasses import asdict, replace
from pathlib import Path

from lib import paths
from lib.files import write_json
from lib.geometry import check
from lib.landmarks import Detector
from lib.provenance import plain
from lib.recordings import Recording, read_image
from lib.training.evaluation import evaluate
from lib.training.loop import PRESETS, Training, load_training, train
from lib.training.samples import labelled_images
from lib.training.shards import generate, propose, shards_of
from lib.training.stages import STAGES, assemble, finetune, stage_config, stage_data, training_of


def main(argv: list[str] | None = None) -> int:
    """`python3 -m lib train`: simulate training data, train or fine-tune the detector's stages (resuming), assemble them."""
    parser = argparse.ArgumentParser(prog="python3 -m lib train", description=main.__doc__.split(": ", 1)[1])
    add = parser.add_argument
    add("what", choices=["generate", "propose", *STAGES, "finetune", "assemble", "export"],
        help="generate: simulate the training data; propose: find what the detector --initial takes for tools in it; frame, "
        "tool, closeup: train this stage (tool: also on the proposals, if there are any); finetune: train all stages further "
        "on labelled recordings; assemble: join the stages to a detector with its card; export: write ONNX")  # fmt: skip
    add("recordings", nargs="*", type=Path, help="labelled recordings; finetune holds out the end of each")
    add("--data", type=Path, default=paths.CACHE / "landmarks", help="folder of the simulated shards")
    add("--folder", type=Path, default=paths.CACHE / "training", help="folder of the checkpoints, with one folder per stage")
    add("--out", type=Path, help="finetune, assemble: weights file to write; export: the one to read (default: shipped)")
    add("--scenes", type=int, default=120, help="generate: number of shards of 64 small scenes")
    add("--closeups", type=int, default=40, help="generate: number of shards of 1024 closeups")
    add("--held-out", type=int, default=24, help="generate: number of shards of 16 full scenes, for the error models")
    add("--photographs", type=Path, help="generate: a folder of images, the ground of about a quarter of the new scenes")
    add("--workers", type=int, help="generate, propose: number of processes (default: one per core)")
    add("--preset", choices=sorted(PRESETS), default="best")
    add("--steps", type=int, default=6000)
    add("--rate", type=float, help="learning rate (default: the preset's)")
    add("--minutes", type=float, help="finetune: stop after this many minutes")
    add("--features", type=int, help="number of channels (default: as in the shipped detector)")
    add("--seed", type=int, default=0)
    add("--initial", type=Path, help="a checkpoint of the stage, a weights file, or a name in data/models, to start from")
    add("--every", type=int, default=1, help="finetune: use every N-th labelled frame")
    add("--note", action="append", default=[], help="assemble: a line for the card; may be repeated")
    add("--onnx", type=Path, default=paths.CACHE / "onnx", help="export: folder of the ONNX files")
    a = parser.parse_args(argv)
    check(a, "every steps features workers", lambda v: v is None or v >= 1, "must be at least 1")
    check(a, "seed scenes closeups held_out", lambda v: v >= 0, "must not be negative")
    check(a, "rate minutes", lambda v: v is None or v > 0, "must be positive")
    if a.what == "finetune" and any(getattr(a, name) != parser.get_default(name) for name in ("rate", "features", "preset")):
        parser.error("finetune: takes no --rate, --features or --preset; it has its own.")
    if a.recordings and a.what not in ("finetune", "assemble"):
        parser.error(f"{a.what}: takes no recordings.")
    if a.what == "generate":
        photographs = _images(a.photographs) if a.photographs else ()
        for kind, count in {"held_out": a.held_out, "scenes": a.scenes, "closeups": a.closeups}.items():
            generate(a.data, kind, count, workers=a.workers, photographs=photographs)
    elif a.what == "propose":
        propose(a.data, a.initial, workers=a.workers)
    elif a.what == "finetune":
        _finetune(a)
    elif a.what == "assemble":
        if a.out is None:
            raise ValueError("assemble: give a weights file to write with --out.")
        assemble(a.folder, a.data, a.out, a.recordings, a.note, Detector.load(a.initial) if a.initial else None)
    elif a.what == "export":
        from lib.landmarks.export import export  # nothing else needs the package onnx

        for stage, (path, difference) in export(Detector.load(a.out), a.onnx).items():
            print(f"{stage}: {path}, at most {difference:.2g} px from torch")
    else:
        config = stage_config(a.what, preset=a.preset, features=a.features)
        config = replace(config, steps=a.steps, seed=a.seed, validate_every=200, learning_rate=a.rate or config.learning_rate)
        initial = _start(a.initial, a.what) if a.initial else None
        print(train(config, *stage_data(a.what, a.data), a.folder / a.what, initial=initial).provenance["metrics"])
    return 0


def _images(folder: Path) -> list[Path]:
    """List the image files of a folder, and check that each can be read."""
    found = sorted(path.resolve() for path in folder.rglob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not found:
        raise FileNotFoundError(f"{folder}: holds no .png or .jpg; give --photographs a folder of images.")
    for path in found:
        read_image(path)  # the error names a damaged file
    return found


def _start(path: Path, stage: str) -> Training:
    try:
        return load_training(path)
    except (FileNotFoundError, ValueError):
        return training_of(Detector.load(path), stage)


def _finetune(a: argparse.Namespace) -> None:
    if not a.recordings or a.out is None:
        raise ValueError("finetune: give labelled recordings, and a weights file to write with --out.")
    a.out.parent.mkdir(parents=True, exist_ok=True)  # it fails before the training, not after it
    training, held_out = [], []
    for recording in map(Recording.open, a.recordings):
        images = list(labelled_images(recording, every=a.every))
        cut = 3 * len(images) // 4
        if cut and images[cut].name.split()[1] == images[cut - 1].name.split()[1]:
            cut -= 1  # both views of a frame are held out
        training += images[:cut]
        held_out += images[cut:]
    detector = Detector.load(a.initial)
    options = {"simulated": a.data if shards_of(a.data, "scenes") else None, "steps": a.steps, "minutes": a.minutes}
    tuned = finetune(detector, training, held_out, a.folder / "finetune", seed=a.seed, **options)
    tuned.save(a.out)
    for name, scores in (("before", evaluate(detector, held_out).scores), ("after", evaluate(tuned, held_out).scores)):
        print(f"{name}: PCK@0.05 {scores.pck_0_05:.1f} %, median error {scores.median_px:.2f} px on held-out images")


def main_evaluate(argv: list[str] | None = None) -> int:
    """`python3 -m lib evaluate`: scores of a detector on a labelled recording, printed and, on request, written as JSON."""
    parser = argparse.ArgumentParser(prog="python3 -m lib evaluate", description=main_evaluate.__doc__.split(": ", 1)[1])
    parser.add_argument("recording", type=Path, help="folder of a recording with truth/ or annotations.json")
    parser.add_argument("--weights", help="weights file or name in data/models (default: the shipped ones)")
    parser.add_argument("--every", type=int, default=1, help="evaluate every N-th labelled frame")
    parser.add_argument("--json", type=Path, help="write the scores here")
    a = parser.parse_args(argv)
    check(a, "every", lambda v: v >= 1, "must be at least 1")
    if a.json and not a.json.parent.is_dir():
        parser.error(f"--json: there is no folder {a.json.parent}; make it first.")
    result = evaluate(Detector.load(a.weights), labelled_images(Recording.open(a.recording), every=a.every), progress=True)
    rows = {"all": result.scores} | result.by_landmark() | result.by_visibility()
    shown = {
        "PCK@0.01": "pck_0_01", "PCK@0.05": "pck_0_05", "PCK@0.10": "pck_0_10", "median px": "median_px", "95 % px": "p95_px",
        "NEES (2)": "nees", "in 95 % ellipse": "coverage_95", "missed": "missed", "labels": "labels",
    }  # fmt: skip
    print(" " * 10 + "".join(f"{title:>16}" for title in shown))
    for name, scores in rows.items():
        print(f"{name:10}" + "".join(f"{getattr(scores, field):>16.6g}" for field in shown.values()))
    print("bias {:+.2f}, {:+.2f} px".format(*result.scores.bias_px))
    for name, value in result.detection().items():
        print(f"{name.replace('_', ' ')}, confidence above 0.5: {value:.1f} %")
    if a.json:
        write_json(a.json, plain({name: asdict(s) for name, s in rows.items()}))
    return 0


if __name__ == "__main__":  # for torchrun
    sys.exit(main())
