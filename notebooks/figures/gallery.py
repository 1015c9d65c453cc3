"""Copy the README's figures from a run: ``.venv/bin/python -m notebooks.figures.gallery RUN``."""

import argparse
import json
import shutil
from pathlib import Path

from PIL import Image

from lib import files, paths

#: Figures that the README shows.
README_FIGURES = ("overview", "landmark_detection", "reconstruction_surface", "calibration_ellipsoids",
                  "registration_errors_recorded", "pipeline_push")  # fmt: skip


def renew_gallery(run: Path) -> None:
    """Copy the README's figures from a run of all notebooks on the shipped recording.  Raises OSError for another run."""
    made_by = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    figures = run / "figures"
    chosen = [next(iter(sorted(figures.glob(f"{name}.*"))), figures / name) for name in README_FIGURES]
    if lacking := [path.stem for path in chosen if not path.is_file()]:
        raise FileNotFoundError(f"{figures}: no picture {', '.join(lacking)}; run all notebooks.")
    if made_by["parameters"].get("recording") or "weights" not in made_by:
        raise OSError(f"{run}: not a run of this version on the recording that ships; run all notebooks without -p.")
    for path in chosen:
        for old in paths.GALLERY.glob(f"{path.stem}.*"):
            old.unlink()
        if path.suffix == ".svg":
            shutil.copy(path, paths.GALLERY)
        elif getattr(picture := Image.open(path), "n_frames", 1) > 1:  # a film
            picture.save(paths.GALLERY / f"{path.stem}.webp", save_all=True, quality=70)
        else:  # a tenth of the PNG's size; full colour resolution
            picture = picture.convert("RGB")
            picture.thumbnail((1300, 1300))
            picture.save(paths.GALLERY / f"{path.stem}.jpg", quality=88, subsampling=0)
    files.write_json(paths.GALLERY / "made_by.json", {k: made_by[k] for k in ("started", "commit", "machine", "weights")})


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m notebooks.figures.gallery", description="Copy the README's figures.")
    parser.add_argument("run", type=Path, metavar="RUN", help="the folder of a run of all notebooks")
    try:
        renew_gallery(parser.parse_args().run)
    except OSError as error:
        parser.error(str(error))
