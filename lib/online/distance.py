"""From tip to retina: the position of each landmark, its distance from the surface, and the standard deviation of that.

The position is the robot's report, plus the robot's constant error as calibrated, plus a correction that changes slowly, as
when a tool slips or a robot bends.  A Kalman filter estimates the correction from the triangulated landmarks of each frame.
So the distances have the robot's small noise and not the detector's.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from lib.correspondences import LANDMARKS
from lib.online.result import FrameResult, Settings
from lib.online.tracker import RigTracker
from lib.surface import Reconstruction

_WALK_S = 1.0  # in this time the correction's random walk grows as far as eye or cameras may move (`Settings.eye_mm_s`)
_SMOOTH_S = 0.2  # time constant over which the robot's velocity is averaged
_SILENT_S = 0.5  # after a longer gap without a report the velocity is unknown


@dataclass(frozen=True, eq=False)
class Surface:
    """A reconstruction, the number and time of its frame, and the seconds of its stages.

    `epipolar_px` is the median distance of its matches from the epipolar lines; infinite if the matcher refused the rig.
    """

    reconstruction: Reconstruction | None
    index: int
    time_s: float
    seconds: dict[str, float]
    failures: dict[str, str]  # stage -> why there is no reconstruction
    epipolar_px: float = float("nan")


class TipDistance:
    """Follows the landmarks and measures their distance to the newest surface."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.reset()
        # Newest report of each landmark, its velocity and time.
        self._x, self._velocity, self._moved_s = np.full((3, 3), np.nan), np.full((3, 3), np.nan), np.full(3, np.nan)

    def reset(self) -> None:
        """Forget the correction, since the cameras that measured it have moved."""
        self._correction, self._time, self._seen_s = np.zeros((len(LANDMARKS), 3)), float("nan"), float("inf")
        self._covariance = np.tile(self.settings.slip_mm**2 * np.eye(3), (len(LANDMARKS), 1, 1))

    def measure(self, result: FrameResult, tracker: RigTracker, x_mm: np.ndarray, at: Surface | None) -> None:
        """Set the result's distances to the newest surface `at`, their standard deviations, approach and alarm.

        `x_mm` (3, 3) is the robot's report, NaN where it is silent or not believed.
        """
        seen, covariance = self.triangulate(result, tracker)
        robot = np.isfinite(x_mm).all(axis=1)
        self._predict(result.time_s, x_mm)
        self._seen_s = result.time_s if np.isfinite(seen).any() else self._seen_s
        if result.state == "tracking":
            gap, noise = seen - tracker.corrected(result.landmarks).x_mm, covariance * tracker.persistence
            for k in np.flatnonzero(np.isfinite(gap).all(axis=1) & np.isfinite(noise).all(axis=(1, 2))):
                gain = self._covariance[k] @ np.linalg.inv(self._covariance[k] + noise[k])
                self._correction[k] += gain @ (gap[k] - self._correction[k])
                self._covariance[k] = (np.eye(3) - gain) @ self._covariance[k]
        error_mm, error_covariance = tracker.robots_error(result.landmarks)
        x = np.where(robot[:, None], x_mm + error_mm + self._correction, seen)
        own = self._covariance + error_covariance + self.settings.robot_accuracy_mm**2 * np.eye(3)
        covariance = np.where(robot[:, None, None], own, covariance)
        age_s = float("nan") if at is None else result.time_s - at.time_s
        if not 0.0 <= age_s <= self.settings.stale_s:  # negative if the clock was restarted
            return
        surface, camera = at.reconstruction.surface, at.reconstruction.rig.left
        found, view = surface.distance(x, camera), camera.viewing_direction
        result.distance_mm, result.normal_mm = found.along_view_mm, found.along_normal_mm
        # Unseen motions: of the eye since the surface was made, and of the cameras since the landmarks were last seen.
        drift = self.settings.eye_mm_s * max(age_s, result.time_s - self._seen_s)
        if not len(rows := np.flatnonzero(np.isfinite(found.along_view_mm))):
            return
        u = camera.project(x[rows])
        slope = np.stack([surface.derivative(u, order) @ view for order in ((1, 0), (0, 1))], axis=1)
        # Derivative of the distance along the view by the tip's position; the surface point behind the tip moves, too.
        towards = slope @ camera.linear - view
        behind, nearest = np.split(surface.covariance(np.concatenate([u, found.nearest_u[rows]])), 2)
        normal = surface.normal(found.nearest_u[rows])
        for sd, direction, along, own, at_mm in (
            (result.distance_sd_mm, towards, np.broadcast_to(view, towards.shape), behind, surface(u)),
            (result.normal_sd_mm, normal, normal, nearest, found.nearest_mm[rows]),
        ):
            # An error of the calibration displaces the surface relative to the robot, but not the tip.
            apart = covariance[rows] + tracker.point_covariance(at_mm)
            variance = np.einsum("ni,nij,nj->n", direction, apart, direction)
            sd[rows] = np.sqrt(variance + np.einsum("ni,nij,nj->n", along, own, along) + drift**2)
        result.approach_mm_s[rows] = -np.einsum("ni,ni->n", towards, self._velocity[rows])
        result.margin_mm = -ndtri(self.settings.miss_rate) * result.distance_sd_mm
        result.too_close = result.distance_mm < self.settings.alarm_mm + result.margin_mm

    @staticmethod
    def triangulate(result: FrameResult, tracker: RigTracker) -> tuple[np.ndarray, np.ndarray]:
        """Triangulate the landmarks (3, 3) mm, also into the result; returns them and their covariance by the detector."""
        data = result.landmarks
        found = tracker.rig.triangulate(data.u_left, data.u_right, tracker.detection_covariance(data))
        result.x_tool_mm = found.x_mm
        return found.x_mm, found.covariance_mm2

    def _predict(self, time_s: float, x_mm: np.ndarray) -> None:
        if np.isfinite(self._time) and time_s > self._time:
            walk_mm2 = self.settings.eye_mm_s**2 * _WALK_S * (time_s - self._time)
            self._covariance = np.minimum(self._covariance + walk_mm2 * np.eye(3), 1.0)
        step_s = time_s - self._moved_s
        known = (step_s > 0) & ((step_s <= _SILENT_S) | (self._moved_s == self._time))  # or in the frame before
        self._time = time_s
        self._velocity[~known] = np.nan
        for k in np.flatnonzero(np.isfinite(x_mm).all(axis=1)):
            if known[k]:
                now = (x_mm[k] - self._x[k]) / step_s[k]
                before = self._velocity[k] if np.isfinite(self._velocity[k]).all() else now
                self._velocity[k] = before + (1.0 - np.exp(-step_s[k] / _SMOOTH_S)) * (now - before)
            self._x[k], self._moved_s[k] = x_mm[k], time_s
