"""Which frame a label belongs to, in what label tools write."""

import json
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from lib.importing.labels import labels_of, read_labels
from tests.importing import foreign

SKELETONS = """<annotations><track id="0" label="forceps">{}</track></annotations>"""
SKELETON = """<skeleton frame="{0}"><points label="tip" outside="0" occluded="{1}" points="{0}.5,2"/></skeleton>"""


def test_skeletons_of_a_cvat_video_have_the_frame_that_their_points_lack(tmp_path):
    path = tmp_path / "annotations.xml"
    path.write_text(SKELETONS.format(SKELETON.format(4, 0) + SKELETON.format(8, 1)))
    assert [tuple(label) for label in labels_of("cvat", path)] == [("4", "tip", 4.5, 2.0, 2), ("8", "tip", 8.5, 2.0, 1)]


def test_frames_of_a_sleap_project_of_images_are_these_images(tmp_path):
    foreign.labels_sleap(tmp_path, foreign.shipped())
    with h5py.File(tmp_path / "left.slp", "r+") as file:
        n = len(file["frames"])
        del file["videos_json"]
        names = [f"{10 * i:06d}.png" for i in range(n)]
        file["videos_json"] = [np.bytes_(json.dumps({"backend": {"filename": names[0], "filenames": names}}))]
    images = {label.image for label in labels_of("sleap", tmp_path / "left.slp")}
    assert images and images <= set(names)


@pytest.mark.parametrize(("image", "first_frame", "frame"), [
    ("left/frame_000006.png", 0, 4),  # the fifth file: number 5 is missing
    ("upload/ab12-frame_000007.png", 0, 5), ("frame_7.jpg", 0, 5), ("3", 0, 3), ("3", 1, 2), ("left/extracted_3.png", 1, 2),
    ("left/frame_000005.png", 0, None), ("left/tool.png", 0, None),
])  # fmt: skip
def test_a_name_has_the_number_of_a_file_and_a_bare_number_counts_frames(tmp_path, image, first_frame, frame):
    there = [n for n in range(1, 11) if n != 5]
    numbers = {f"frame_{n:06d}": k for k, n in enumerate(there)} | {n: k for k, n in enumerate(there)}
    source = SimpleNamespace(
        index=np.repeat(np.arange(9)[:, None], 2, axis=1), reels=[SimpleNamespace(numbers=numbers)] * 2,
        video=SimpleNamespace(layout="two", exchanged=False), time=np.arange(9.0),
    )  # fmt: skip
    labels = SimpleNamespace(
        kind="coco", names={}, file="", left="l.json", right="", sides=("left", "right"), pixel_origin="centre",
        first_frame=first_frame,
    )  # fmt: skip
    content = {"categories": [{"id": 1, "keypoints": ["tip"]}], "images": [{"id": 1, "file_name": image}]}
    content["annotations"] = [{"id": 1, "image_id": 1, "category_id": 1, "keypoints": [300, 200, 2]}]
    (tmp_path / "l.json").write_text(json.dumps(content))
    how = tmp_path, labels, source, ["tip"], (640, 480)
    if frame is None:
        with pytest.raises(ValueError, match="none of its 1 labels belongs"):
            read_labels(*how)
    else:
        assert np.flatnonzero(read_labels(*how).visibility_left[:, 0]).tolist() == [frame]
