"""The Retinal Microsurgery sequences: a folder in their layout, and the real ones where they are at hand."""

import cv2
import numpy as np
import pytest

from notebooks import real_data
from notebooks.studies.retinal import import_retinal_microsurgery


def test_retinal_microsurgery_layout(tmp_path):
    sequence = tmp_path / "seq1"
    sequence.mkdir()
    header = "frame,shaft_x,shaft_y,base_x,base_y,tip_1_x,tip_1_y,tip_2_x,tip_2_y\n"
    (sequence / "landmarks.csv").write_text(header + "7,1,2,3,4,5,6,7,8\n8,1,2,,,5,6,7,8\n")
    with pytest.raises(FileNotFoundError, match="2 of 2 missing"):
        import_retinal_microsurgery(tmp_path)
    for number in (7, 8):
        cv2.imwrite(str(sequence / f"{number:06d}.jpg"), np.zeros((6, 8, 3), np.uint8))
    (read,) = import_retinal_microsurgery(tmp_path)
    assert (read.name, len(read), read.image_size_px) == ("seq1", 2, (8, 6))
    np.testing.assert_array_equal(read.u[0], [[3, 4], [7, 8], [5, 6]])  # the left tip first
    assert np.isnan(read.u[1, 0]).all()
    assert read.image(1).shape == (6, 8, 3)
    with pytest.raises(FileNotFoundError, match=r"landmarks\.csv"):
        import_retinal_microsurgery(tmp_path / "nowhere")


@pytest.mark.skipif(
    real_data.folder("retinal_microsurgery") is None, reason=real_data.missing_line("retinal_microsurgery")
)
def test_real_retinal_microsurgery():
    sequences = import_retinal_microsurgery(real_data.folder("retinal_microsurgery"))
    assert [len(sequence) for sequence in sequences] == [402, 222]
    for sequence in sequences:
        assert sequence.image(len(sequence) // 2).shape == (480, 640, 3)
        assert np.nanmin(sequence.u) >= 0
        assert (np.nanmax(sequence.u, axis=(0, 1)) < [640, 480]).all()
        reach = np.linalg.norm(sequence.u[:, 1:].mean(axis=1) - sequence.u[:, 0], axis=1)
        assert 28 < np.nanmedian(reach) < 63  # the jaw's size that the data set states
