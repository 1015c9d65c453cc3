"""The truth of a simulated recording: exact cameras, landmarks and surface."""

import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator

from lib import files
from lib.cameras import StereoRig
from lib.geometry import points
from lib.recordings.tables import columns, read_table, write_table

_COLUMNS = ["frame", *columns(["x_mm", "y_mm", "z_mm"])]
_COLUMNS += columns(["left_x_px", "left_y_px", "left_visibility", "right_x_px", "right_y_px", "right_visibility"])
_GLINT_COLUMNS = columns(["left_in_glint", "right_in_glint"])  # optional, after the others


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth of a simulated recording.  For evaluation only: no estimator may use it.

    Attributes:
        rig: The exact cameras, affine or near-affine.
        landmarks_mm: (n, 3, 3) exact landmarks at the frames' times, robot frame.
        u_left, u_right: (n, 3, 2) exact px.
        visibility_left, visibility_right: (n, 3) int: 0 outside the image, 1 hidden, 2 visible.
        folder: truth/, which may hold further files of the simulator.
        in_glint_left, in_glint_right: (n, 3) bool, True if saturated light lies on the landmark or within 3 px of it;
            None if the recording does not state it.
    """

    rig: StereoRig
    landmarks_mm: np.ndarray
    u_left: np.ndarray
    u_right: np.ndarray
    visibility_left: np.ndarray
    visibility_right: np.ndarray
    folder: Path
    in_glint_left: np.ndarray | None = None
    in_glint_right: np.ndarray | None = None

    @classmethod
    def read(cls, folder: Path, n: int) -> Self:
        """Read the truth of `n` frames; errors name the file."""
        path = folder / "landmarks.csv"
        table = read_table(path, _COLUMNS, optional=_GLINT_COLUMNS, n_frames=n)
        u, visibility = np.split(table[:, 10:28].reshape(n, 3, 2, 3), [2], axis=-1)
        visibility = np.nan_to_num(visibility[..., 0]).astype(np.int64)
        glints = table[:, 28:].reshape(n, 3, 2)
        known = not np.isnan(glints).all()
        if known and not np.isin(glints, (0, 1)).all():
            raise ValueError(f"{path}: in_glint is 0 or 1 for every landmark.")
        in_glint = [glints[:, :, side] == 1 if known else None for side in (0, 1)]
        rig, x = StereoRig.load(folder / "rig.json"), table[:, 1:10].reshape(n, 3, 3)
        return cls(rig, x, u[:, :, 0], u[:, :, 1], visibility[:, :, 0], visibility[:, :, 1], folder, *in_glint)

    def write(self, surface: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None) -> None:
        """Write files that `read` reads into `folder`, which is made.  A `RecordingWriter` has ``writer.folder / "truth"``.

        `surface` is (x_px (a,), y_px (b,), x_mm (b, a, 3)): surface points seen at a grid of left pixels.
        """
        self.folder.mkdir(exist_ok=True)
        self.rig.save(self.folder / "rig.json")
        n = len(self.landmarks_mm)
        sides = (self.u_left, self.visibility_left), (self.u_right, self.visibility_right)
        image = np.stack([np.dstack([u, visibility]) for u, visibility in sides], axis=2)
        table = np.column_stack([np.arange(n), np.reshape(self.landmarks_mm, (n, 9)), image.reshape(n, 18)])
        if self.in_glint_left is not None:
            glints = np.stack([self.in_glint_left, self.in_glint_right], axis=-1).astype(bool)
            table = np.column_stack([table, glints.reshape(n, 6)])
        names, decimals = [*_COLUMNS, *_GLINT_COLUMNS], [0] + [7] * 9 + [5, 5, 0] * 6 + [0] * 6
        write_table(self.folder / "landmarks.csv", names[: table.shape[1]], table, decimals[: table.shape[1]])
        if surface is not None:
            x_px, y_px, x_mm = (np.asarray(values) for values in surface)
            with files.whole(self.folder / "surface.npz") as partial:
                np.savez_compressed(partial, x_px=x_px, y_px=y_px, x_mm=x_mm.astype(np.float32))

    @cached_property
    def _surface(self) -> RegularGridInterpolator:
        path = self.folder / "surface.npz"
        if not path.is_file():
            raise FileNotFoundError(f"{path}: this recording stores no surface.")
        try:
            with np.load(path, allow_pickle=False) as stored:
                x_px, y_px, x_mm = (np.asarray(stored[key], dtype=np.float64) for key in ("x_px", "y_px", "x_mm"))
            if x_mm.shape != (len(y_px), len(x_px), 3):
                raise ValueError(f"x_mm is {x_mm.shape}, expected {(len(y_px), len(x_px), 3)}")
            return RegularGridInterpolator((y_px, x_px), x_mm, method="linear", bounds_error=False)
        except (ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: not a surface grid with x_px, y_px, x_mm ({error}).") from None

    def surface(self, u_left: ArrayLike) -> np.ndarray:
        """The surface points (n, 3) mm, robot frame, seen at left pixels (n, 2); NaN outside the stored grid."""
        return self._surface(points(u_left, 2, "u_left")[:, ::-1])
