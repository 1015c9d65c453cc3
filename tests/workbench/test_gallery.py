"""The README's pictures: of a run with the weights that ship."""

import json
import re

import cv2
import numpy as np
import pytest
from PIL import Image

from lib import files, paths
from notebooks.figures import gallery as pictures


def test_no_picture_of_the_readme_is_older_than_the_weights():
    made_by = json.loads((paths.GALLERY / "made_by.json").read_text(encoding="utf-8"))
    assert made_by["weights"] == files.digest(paths.MODELS / "default.safetensors"), "notebooks.figures.gallery renews them"
    shown = re.findall(r"data/gallery/(\w+)\.", (paths.ROOT / "README.md").read_text(encoding="utf-8"))
    assert set(shown) == set(pictures.README_FIGURES)


def test_the_gallery_takes_a_runs_pictures_or_changes_nothing(tmp_path, monkeypatch):
    run, gallery = tmp_path / "run", tmp_path / "gallery"
    (run / "figures").mkdir(parents=True)
    gallery.mkdir()
    monkeypatch.setattr(paths, "GALLERY", gallery)
    made_by = {"started": "today", "commit": None, "machine": {}, "weights": "abc", "parameters": {}}
    files.write_json(run / "metrics.json", made_by)
    for name in pictures.README_FIGURES[1:]:
        cv2.imwrite(str(run / "figures" / f"{name}.png"), np.full((60, 2600, 3), 80, np.uint8))
    pages = [Image.fromarray(np.full((40, 60, 3), 80 * k, np.uint8)) for k in range(3)]
    pages[0].save(run / "figures" / "pipeline_push.png", save_all=True, append_images=pages[1:])
    with pytest.raises(FileNotFoundError, match="no picture overview"):
        pictures.renew_gallery(run)
    assert not list(gallery.iterdir())
    (run / "figures" / "overview.svg").write_text("<svg/>", encoding="utf-8")
    (gallery / "overview.png").touch()
    files.write_json(run / "metrics.json", made_by | {"parameters": {"recording": "mine"}})
    with pytest.raises(OSError, match="recording that ships"):
        pictures.renew_gallery(run)
    assert len(list(gallery.iterdir())) == 1
    files.write_json(run / "metrics.json", made_by)
    pictures.renew_gallery(run)
    assert cv2.imread(str(gallery / "landmark_detection.jpg")).shape == (30, 1300, 3)
    assert Image.open(gallery / "pipeline_push.webp").n_frames == 3
    assert [path.name for path in gallery.glob("overview.*")] == ["overview.svg"]
    assert json.loads((gallery / "made_by.json").read_text(encoding="utf-8"))["weights"] == "abc"


@pytest.mark.parametrize("name", pictures.README_FIGURES)
def test_every_picture_is_there_once(name):
    assert len(list(paths.GALLERY.glob(f"{name}.*"))) == 1
