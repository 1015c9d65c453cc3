"""Rigs and data that several tests share."""

import numpy as np

from lib.calibration.offsets import tool_axes
from lib.cameras import NearAffineCamera, StereoRig
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform
from lib.simulator.rig import IMAGE_SIZE_PX, ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.simulated_rows import simulate_correspondences

LANDMARKS_MM = np.array([[0.0, 0.0, 0.0], [3.0, -0.5, 0.1], [3.0, 0.5, 0.1]])
OFFSETS_MM = np.array([[0.040, 0.0, -0.010], [-0.010, 0.004, 0.006], [0.012, -0.003, 0.002]])


def data(n=120, seed=0, **options):
    return simulate_correspondences(n, rng=np.random.default_rng(seed), **options)


def near_rig(distance_mm=200.0, radial=0.0):
    """The reference rig at a finite working distance; infinity is the reference rig itself."""
    rig = reference_rig()
    if np.isinf(distance_mm):
        return rig
    centre = (np.array(IMAGE_SIZE_PX) - 1) / 2
    return StereoRig(
        *(NearAffineCamera(c.matrix, 1 / distance_mm, centre, ROBOT_FROM_MICROSCOPE.t, radial) for c in (rig.left, rig.right))
    )


def tool_sweep(
    seed, *, frames=75, turn_rad=0.4, offset_mm=OFFSETS_MM, distance_mm=np.inf, sigma_px=0.8, span_mm=(6, 3, 1.2),
    motion=None,
):  # fmt: skip
    """Correspondences of a turning tool whose landmarks are seen beside their report, the true rig, true positions (n, 3)."""
    rng = np.random.default_rng(seed)
    rig = near_rig(distance_mm) if motion is None else near_rig(distance_mm).moved(motion)
    poses = [
        ROBOT_FROM_MICROSCOPE.compose(
            RigidTransform.from_rotation_vector(
                turn_rad * rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3) * span_mm - [2, 0, 0]
            )
        )
        for _ in range(frames)
    ]
    x = np.stack([pose.apply(LANDMARKS_MM) for pose in poses])
    seen = x + np.einsum("nij,kj->nki", tool_axes(x), offset_mm)
    u = [p + rng.normal(0, sigma_px, p.shape) for p in rig.project(seen.reshape(-1, 3))]
    reported = (x + rng.normal(0, 0.01, x.shape)).reshape(-1, 3)
    frame, landmark = np.divmod(np.arange(3 * frames), 3)
    return Correspondences.of_points(reported, *u, frame=frame, landmark=landmark), rig, x.reshape(-1, 3)
