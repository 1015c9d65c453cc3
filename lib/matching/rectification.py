"""Affine rectification: two 2-D affine maps that make the epipolar lines of a rig the rows of a common image, the canvas.

For an affine rig a point at u_left is imaged at u_right = H (u_left - t_l) + t_r + z e, where z = d.x is its depth along
the left viewing direction d, H = A_r pinv(A_l) and e = A_r d.  So the right image warped by H equals the left one up to a
shift along H^-1 e that is linear in depth, if the two viewing directions differ.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from lib.cameras import AffineCamera, StereoRig

#: The rig of an already rectified pair: x = (x_left, y, disparity) px instead of mm, u_right = (x - disparity, y).
#: Depth is then disparity (nearer is larger), so `depth_range_mm` is the range of disparity in px.
RECTIFIED = StereoRig(AffineCamera([[1, 0, 0, 0], [0, 1, 0, 0]]), AffineCamera([[1, 0, -1, 0], [0, 1, 0, 0]]))


@dataclass(frozen=True, eq=False)
class Rectification:
    """A canvas that covers the left image.  A point has the same canvas row in both images."""

    left_from_canvas: np.ndarray  # (2, 3) affine map from canvas to image pixels
    right_from_canvas: np.ndarray  # the same for the right image, for points at `reference_depth_mm`
    size_px: tuple[int, int]  # (width, height) of the canvas
    displacement_px_per_mm: float  # shift along the canvas's +x in the right image, for each mm beyond the reference
    reference_depth_mm: float  # depth d.x along the left viewing direction d at which the displacement is 0

    def depth_range_mm(self, displacement_range_px: tuple[float, float]) -> tuple[float, float]:
        """(near, far) depth of a range of displacements on the canvas."""
        ends = self.reference_depth_mm + np.asarray(displacement_range_px) / self.displacement_px_per_mm
        return float(ends.min()), float(ends.max())

    def shared_range_px(self, shape_right: tuple[int, int]) -> tuple[float, float]:
        """(low, high) displacements at which both images, the right one of the shape (h, w), have a column in common."""
        corners = np.array(list(np.ndindex(2, 2))) * np.subtract(shape_right[::-1], 1)
        x = np.linalg.solve(self.right_from_canvas[:, :2], (corners - self.right_from_canvas[:, 2]).T)[0]
        return float(x.min() - self.size_px[0]), float(x.max())

    def search_range_px(self, depth_range_mm: tuple[float, float], shape_right: tuple[int, int]) -> tuple[float, float]:
        """(low, high) displacements of a range of depth, limited to the part that both cameras see; `shape_right` is (h, w).

        If they see nothing of it, a ValueError states the depths that they see.
        """
        low, high = np.sort(np.subtract(depth_range_mm, self.reference_depth_mm) * self.displacement_px_per_mm).tolist()
        visible = self.shared_range_px(shape_right)
        if high < visible[0] or low > visible[1]:
            near, far = self.depth_range_mm(visible)
            what = f"nothing from {depth_range_mm[0]:g} to {depth_range_mm[1]:g} mm along the left viewing direction"
            raise ValueError(f"depth_range_mm: {what} is seen by both cameras; they share {near:.1f} to {far:.1f} mm.")
        return max(low, visible[0]), min(high, visible[1])


def on_image(image_from_canvas: np.ndarray, canvas: np.ndarray) -> np.ndarray:
    """Image pixels (n, 2) of canvas points (n, 2); for the right image, add the displacement to the points first."""
    return canvas @ image_from_canvas[:, :2].T + image_from_canvas[:, 2]


def rectify(rig: StereoRig, shape_left: tuple[int, int], shape_right: tuple[int, int], *, scale: float = 1) -> Rectification:
    """The rectification of a rig for images of these shapes (h, w), with `scale` canvas pixels per left pixel.

    For near-affine cameras it uses their affine matrices.  A ValueError refuses cameras with the same viewing direction.
    """
    A_l, A_r = rig.left.linear, rig.right.linear
    H = A_r @ np.linalg.pinv(A_l)
    if not rig.sees_depth:
        raise ValueError("rig: both cameras look along the same direction, so depth cannot be seen; calibrate again.")
    shift = np.linalg.solve(H, A_r @ rig.left.viewing_direction)
    direction = shift / np.linalg.norm(shift) * (1.0 if shift[0] >= 0 else -1.0)
    Q = np.array([direction, [-direction[1], direction[0]]])

    corners = (np.array(list(np.ndindex(2, 2))) * shape_left[::-1] - 0.5) @ Q.T
    origin = corners.min(axis=0)
    size = tuple(int(n) for n in np.ceil((corners.max(axis=0) - origin) * scale - 1e-6))
    # canvas = scale (Q u - origin) - 1/2, so that with Q = 1 and scale 1 the canvas is the left image.
    left = np.column_stack([Q.T / scale, Q.T @ (0.5 / scale + origin)])
    at_zero = H @ (left[:, 2] - rig.left.offset_px) + rig.right.offset_px
    right_linear = H @ left[:, :2]

    # At the reference depth the middle pixels lie together, up to the shift off the line.  So the canvas does not depend on
    # the origin of the rig's frame, and a rectified pair is moved by whole pixels, thus not resampled.
    middle_left, middle_right = np.array(shape_left[::-1]) // 2, np.array(shape_right[::-1]) // 2
    gap = middle_right - (H @ (middle_left - rig.left.offset_px) + rig.right.offset_px)
    shift_px = float(np.linalg.solve(right_linear, gap)[0])
    displacement = float(scale * direction @ shift)
    right = np.column_stack([right_linear, at_zero + right_linear @ np.array([shift_px, 0.0])])
    return Rectification(left, right, size, displacement, shift_px / displacement)


def warp(
    gray: np.ndarray, image_from_canvas: np.ndarray, size_px: tuple[int, int], *, shift_px: tuple[float, float] = (0, 0),
    mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Resample an image (h, w), float32 or uint8, on a canvas by `image_from_canvas` (2, 3), anti-aliased if that is coarser.

    The result covers `size_px` (width, height) of the canvas from pixel `shift_px` on; `mask` (h, w) bool is True = ignore.
    Returns (height, width) float32, with the border pixels continued; and bool, False outside the image and where masked.
    """
    linear = image_from_canvas[:, :2]
    offset = image_from_canvas[:, 2] + linear @ np.asarray(shift_px, dtype=np.float64)
    seen = np.full(gray.shape, 255, np.uint8) if mask is None else (~mask).view(np.uint8) * np.uint8(255)
    factor = max(1, int(np.sqrt(abs(np.linalg.det(linear))) + 0.25))
    if factor > 1:  # the mean of whole blocks; incomplete blocks are dropped
        rows, columns = gray.shape[0] // factor, gray.shape[1] // factor
        blocks = np.s_[: rows * factor, : columns * factor]
        gray, seen = (cv2.resize(one[blocks], (columns, rows), interpolation=cv2.INTER_AREA) for one in (gray, seen))
        linear, offset = linear / factor, (offset - (factor - 1) / 2) / factor
    matrix, flags = np.column_stack([linear, offset]), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    gray = gray.astype(np.float32, copy=False)
    out = cv2.warpAffine(gray, matrix, size_px, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return out, cv2.warpAffine(seen, matrix, size_px, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=0) == 255
