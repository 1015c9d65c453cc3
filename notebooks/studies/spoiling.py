"""Simulated correspondences of good and spoiled recordings, with the truth that judges the workbench's results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.spatial.transform import Rotation

from lib.calibration import Calibration, calibrate
from lib.cameras import Camera, NearAffineCamera, StereoRig
from lib.correspondences import Correspondences, pair_with_robot
from lib.geometry import RigidTransform
from lib.recordings import Kinematics
from lib.simulator import Microscope
from lib.trust import diagnose, judge

#: First seed of the recordings on which thresholds are set, and of those that only judge.
SETS = {"setting": 0, "judging": 50_000}
_SIZE = (1920, 1080)


@dataclass(frozen=True, eq=False)
class Take:
    """A recording without its images: the data that a lab has, and their truth.

    Attributes
    ----------
    name, strength, causes:
        The fault and its strength ("" if there is none), and the names of the hypotheses that are right.
    data, kinematics, offset_s, readout_s, image_size_px, robot_accuracy_mm:
        The data that the lab has.
    rigs, points_mm:
        The true rigs (more than one if a camera moved) and (k, 3) test positions, in the true robot frame.
    """

    name: str
    strength: str
    causes: tuple[str, ...]
    data: Correspondences
    kinematics: Kinematics
    offset_s: float
    readout_s: float
    rigs: tuple[StereoRig, ...]
    points_mm: np.ndarray
    image_size_px: tuple[int, int] = _SIZE
    robot_accuracy_mm: float = 0.010


@dataclass(eq=False)
class Scene:
    """The description of a recording; faults change the scene itself, the pixels or the robot's report."""

    rng: np.random.Generator
    frames: int = 100
    fps: float = 25.0
    speed_mm_s: float = 3.0
    noise_px: float = 1.2
    tail: float = np.inf  # degrees of freedom (Student t) of the detections' errors
    memory: float = 0.0  # correlation of these errors from frame to frame
    shared: float = 0.0  # correlation of these errors between the landmarks of an image
    anisotropy: float = 1.0  # ratio of the errors along the image rows to those across them, with the same RMS
    bias_mm: float = 0.0  # constant offsets of the detected landmarks
    missing: float = 0.0  # share of the detections that are missing
    outliers: float = 0.0  # share of the detections that are at random places
    stated: bool = True  # the detector states covariances
    robot_mm: float = 0.008  # noise of the robot's report, per coordinate
    readout_s: float = 0.012
    inverse_distance_per_mm: float = 0.0
    opening_mm: tuple[float, float] = (0.3, 1.4)
    convergence_deg: float | None = None
    edit_pixels: list[Callable[[Scene, np.ndarray], np.ndarray]] = field(default_factory=list)
    edit_report: list[Callable[[Scene, np.ndarray, np.ndarray], np.ndarray]] = field(default_factory=list)
    stated_readout_s: float | None = None
    offset_s: float = 0.0  # error of the stated offset of the clocks
    camera_late_s: tuple[float | np.ndarray, float | np.ndarray] = (0.0, 0.0)  # delays of both cameras
    rate: float = 1.0  # stated times over true times
    move: tuple[float, RigidTransform] | None = None  # share of the frames before the motion, and the motion of the rig
    drift_px: float = 0.0  # shift of the images from the first frame to the last
    edit_rig: Callable[[StereoRig], StereoRig] | None = None  # changes the cameras

    def path(self) -> Callable[[np.ndarray], np.ndarray]:
        """A random path of the tool: a function from times (...,) to base, tip_1, tip_2 (..., 3, 3) mm, microscope frame."""
        rng, seconds = self.rng, self.frames / self.fps + 6.0
        steps = int(np.ceil(seconds * self.speed_mm_s / 3.0)) + 4
        knots = np.linspace(-3.0, seconds, steps) + rng.uniform(-0.25, 0.25, steps) * seconds / steps
        where = rng.uniform(-1, 1, (steps, 3)) * [6.0, 3.0, 1.4]
        turn = np.column_stack(
            [rng.uniform(-np.pi, np.pi) + rng.normal(0, 0.4, steps), rng.uniform(0.12, 0.6, steps), rng.normal(0, 0.3, steps)]
        )
        curve = PchipInterpolator(knots, np.column_stack([where, turn, rng.uniform(*self.opening_mm, steps)]))
        length = rng.uniform(2.2, 3.6)

        def landmarks(time: np.ndarray) -> np.ndarray:
            value = curve(np.asarray(time))
            centre, (azimuth, pitch, roll), opening = value[..., :3], np.moveaxis(value[..., 3:6], -1, 0), value[..., 6]
            axes = Rotation.from_euler("ZYX", np.stack([azimuth, -pitch, roll], axis=-1).reshape(-1, 3)).as_matrix()
            axes = axes.reshape(*azimuth.shape, 3, 3)
            reach = np.sqrt(length**2 - (opening / 2) ** 2)
            own = np.zeros((*azimuth.shape, 3, 3))
            own[..., 0, 0], own[..., 1, 0], own[..., 2, 0] = -reach / 2, reach / 2, reach / 2
            own[..., 1, 1], own[..., 2, 1] = -opening / 2, opening / 2
            return centre[..., None, :] + np.einsum("...ij,...kj->...ki", axes, own)

        return landmarks

    def take(self, name: str = "", strength: str = "", causes: tuple[str, ...] = ()) -> Take:
        """Simulate the recording: the detections in both images and the robot's report."""
        rng = self.rng
        pose = RigidTransform.from_rotation_vector(
            Rotation.from_rotvec(rng.normal(0, 0.25, 3)).as_matrix() @ np.array([0.15, 2.90, -0.25]), rng.uniform(-30, 30, 3)
        )
        zoom = rng.uniform(85, 125)
        microscope = Microscope(
            pixels_per_mm=(zoom, zoom * rng.uniform(0.96, 1.04)), image_rotation_rad=tuple(rng.normal(0, 0.03, 2)),
            convergence_rad=np.deg2rad(self.convergence_deg or rng.uniform(5, 10)),
            inverse_distance_per_mm=self.inverse_distance_per_mm,
        )  # fmt: skip
        rig, landmarks = microscope.rig(pose), self.path()
        rig = self.edit_rig(rig) if self.edit_rig else rig
        rigs = (rig,) if self.move is None else (rig, rig.moved(self.move[1]))
        time, height = np.arange(self.frames) / self.fps, _SIZE[1]

        def see(view: int) -> np.ndarray:
            row_time = np.repeat(time[:, None], 3, axis=1)
            for _ in range(3):
                at = np.stack([landmarks(row_time[:, k] - self.camera_late_s[view])[:, k] for k in range(3)], axis=1)
                u = [np.reshape(r.project(pose.apply(at.reshape(-1, 3)))[view], (-1, 3, 2)) for r in rigs]
                late = np.zeros(self.frames, bool) if self.move is None else time >= self.move[0] * time[-1]
                u = np.where(late[:, None, None], u[-1], u[0])
                row_time = time[:, None] + self.readout_s * (u[..., 1] / (height - 1) - 0.5)
            return u + self.drift_px * (time / time[-1])[:, None, None] * [0.8, 0.6]

        exact = np.stack([see(0), see(1)], axis=2)  # (m, 3, 2, 2)
        spread = np.exp(rng.normal(0, 0.25, (1, 3, 1, 1))) * self.noise_px
        noise = rng.normal(size=exact.shape)
        for i in range(1, self.frames):
            noise[i] = self.memory * noise[i - 1] + np.sqrt(1 - self.memory**2) * noise[i]
        if self.shared:
            common = rng.normal(size=(self.frames, 1, *noise.shape[2:]))
            noise = np.sqrt(1 - self.shared) * noise + np.sqrt(self.shared) * common
        noise *= np.sqrt(2.0 / (1.0 + self.anisotropy**2)) * np.array([self.anisotropy, 1.0])
        if np.isfinite(self.tail):
            noise /= np.sqrt(rng.chisquare(self.tail, (*exact.shape[:3], 1)) / self.tail)
        u = exact + spread * noise
        if self.bias_mm:
            x = landmarks(time)
            along = x[:, 1:].mean(axis=1) - x[:, 0]
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            shift = rng.normal(0, self.bias_mm, 3)[None, :, None] * along[:, None]
            A = rig.linear @ pose.R
            u = u + np.einsum("cij,mkj->mkci", A.reshape(2, 2, 3), shift)
        wrong = rng.random(u.shape[:3]) < self.outliers
        u[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 2)) * _SIZE
        u[rng.random(u.shape[:3]) < self.missing] = np.nan
        for edit in self.edit_pixels:
            u = edit(self, u)
        robot = np.arange(-1.5, time[-1] + 1.5, 0.01)
        report = pose.apply(landmarks(robot).reshape(-1, 3)).reshape(-1, 3, 3)
        report = report + rng.normal(0, self.robot_mm, report.shape)
        for edit in self.edit_report:
            report = edit(self, robot, report)
        kinematics = Kinematics(robot, report)
        readout = self.readout_s if self.stated_readout_s is None else self.stated_readout_s
        covariance = np.broadcast_to(np.eye(2), (*u.shape[:3], 2, 2)) * (spread**2)[..., None] if self.stated else None
        data = pair_with_robot(
            u[:, :, 0], u[:, :, 1], position=kinematics.at, time_s=time * self.rate, height_px=height, readout_s=readout,
            offset_s=self.offset_s, covariance_px2=covariance,
        )  # fmt: skip
        points = pose.apply(rng.uniform(-1, 1, (60, 3)) * [6.0, 3.0, 1.2])
        return Take(name, strength, causes, data, kinematics, self.offset_s, readout, rigs, points)


@dataclass(frozen=True)
class Result:
    """The workbench's result for a take.

    Attributes
    ----------
    effect:
        RMS 3D error of the calibration at the test positions, divided by its stated standard deviation, for the worst of the
        rigs; infinite if the calibration was refused.
    level, named:
        Level of the verdict; cause named by the diagnosis, "" if none.
    text:
        The diagnosis in words.
    """

    take: Take
    effect: float
    level: str
    named: str
    text: str

    @property
    def right(self) -> bool:
        """True if the right cause was named, or none if there is no fault."""
        return self.named in (self.take.causes or ("",))


def examine(take: Take, fit: Callable[..., Calibration] = calibrate) -> Result:
    """Calibrate by `fit`, diagnose and judge, as `lib.trust.assess` does; with `fit=calibrate` the cameras are affine."""
    calibration, error, effect = None, None, np.inf
    try:
        calibration = fit(take.data, image_size_px=take.image_size_px)
    except ValueError as refused:
        error = refused
    if calibration is not None:
        own = calibration.point_covariance(take.points_mm, detection=False)
        sd = np.sqrt(np.trace(own, axis1=1, axis2=2).mean())
        missed = [calibration.pair.triangulate(*rig.project(take.points_mm)).x_mm - take.points_mm for rig in take.rigs]
        effect = max(float(np.sqrt((d**2).sum(axis=1).mean())) for d in missed) / sd
    diagnosis = diagnose(
        take.data, kinematics=take.kinematics, offset_s=take.offset_s, readout_s=take.readout_s,
        image_size_px=take.image_size_px, near=calibration is not None and calibration.inverse_distance_per_mm[1] > 0,
        robot_accuracy_mm=take.robot_accuracy_mm,
    )  # fmt: skip
    verdict = judge(
        take.data, calibration, diagnosis=diagnosis, robot_accuracy_mm=take.robot_accuracy_mm, error=error
    )
    best = diagnosis.best
    named, text = ("", "no fault found") if best is None else (best.name, f"{best.name}: {best.text} {best.cure}")
    return Result(take, effect, verdict.level, named, text)


# --- ways of spoiling: each takes a scene and a strength


def _pixels(edit: Callable[[Scene, np.ndarray], np.ndarray]) -> Callable[[Scene], None]:
    return lambda scene: scene.edit_pixels.append(edit)


def _report(edit: Callable[[Scene, np.ndarray, np.ndarray], np.ndarray]) -> Callable[[Scene], None]:
    return lambda scene: scene.edit_report.append(edit)


def _set(**values: object) -> Callable[[Scene], None]:
    def apply(scene: Scene) -> None:
        for name, value in values.items():
            setattr(scene, name, value)

    return apply


def _tips(views: tuple[int, ...], share: float) -> Callable[[Scene], None]:
    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        frames, u = scene.rng.random(len(u)) < share, u.copy()
        for view in views:
            u[frames, 1:, view] = u[frames, 2:0:-1, view]
        return u

    return _pixels(edit)


def _wrong(share: float, sizes: tuple[float, ...] = (35.0, 180.0)) -> Callable[[Scene], None]:
    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        wrong = scene.rng.random(u.shape[:3]) < share
        return u + wrong[..., None] * scene.rng.choice(sizes, (*u.shape[:3], 1)) * scene.rng.normal(size=u.shape)

    return _pixels(edit)


def _scale(factors: tuple[float, float, float]) -> Callable[[Scene], None]:
    return _report(lambda scene, t, x: x * factors)


def _rigid(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    middle, across = x[:, 1:].mean(axis=1), x[:, 2] - x[:, 1]
    across = across / np.linalg.norm(across, axis=1, keepdims=True) * np.mean(scene.opening_mm) / 2
    return np.stack([x[:, 0], middle - across, middle + across], axis=1)


def _both(*ways: Callable[[Scene], None]) -> Callable[[Scene], None]:
    def apply(scene: Scene) -> None:
        for way in ways:
            way(scene)

    return apply


def _offset(landmark: int, size_mm: float) -> Callable[[Scene], None]:
    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        along = x[:, 1:].mean(axis=1) - x[:, 0]
        x = x.copy()
        x[:, landmark] += size_mm * along / np.linalg.norm(along, axis=1, keepdims=True)
        return x

    return _report(edit)


def _one_landmark(landmark: int, size_px: float, share: float) -> Callable[[Scene], None]:
    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        u, wrong = u.copy(), scene.rng.random((len(u), 2, 1)) < share
        u[:, landmark] += wrong * scene.rng.normal(0, size_px, (len(u), 2, 2))
        return u

    return _pixels(edit)


def _stretch(share: float, size_px: float) -> Callable[[Scene], None]:
    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        n, u = round(share * len(u)), u.copy()
        first = scene.rng.integers(0, len(u) - n + 1)
        u[first : first + n] += scene.rng.normal(0, size_px, (n, *u.shape[1:]))
        return u

    return _pixels(edit)


def _frozen(share: float) -> Callable[[Scene], None]:
    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        seconds = scene.frames / scene.fps
        first = scene.rng.uniform(0, (1 - share) * seconds)
        rows = (t >= first) & (t < first + share * seconds)
        x = x.copy()
        x[rows] = x[np.flatnonzero(rows)[0]]
        return x

    return _report(edit)


def _frozen_video(share: float) -> Callable[[Scene], None]:
    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        u = u.copy()
        for i in range(1, len(u)):
            if scene.rng.random() < share:
                u[i] = u[i - 1]
        return u

    return _pixels(edit)


def _shuffled(window: int) -> Callable[[Scene], None]:
    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        order = np.argsort(np.arange(len(u)) + scene.rng.uniform(0, window, len(u)))
        return u[order]

    return _pixels(edit)


def _sorted_as_text(scene: Scene, u: np.ndarray) -> np.ndarray:
    return u[sorted(range(len(u)), key=str)]


def _smoothed(window_s: float) -> Callable[[Scene], None]:
    """The log holds moving averages of the positions."""

    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        return uniform_filter1d(x, max(round(window_s / np.median(np.diff(t))), 1), axis=0, mode="nearest")

    return _report(edit)


def _swaying(size_px: float, views: tuple[int, ...], frames: float = 0.1) -> Callable[[Scene], None]:
    """Images shift at random: `size_px` is the RMS per coordinate, `frames` the time scale; two views shift together."""

    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        shift = gaussian_filter1d(scene.rng.normal(size=(len(u), 1, 2)), frames, axis=0)
        u = u.copy()
        u[:, :, list(views)] += (size_px * shift / shift.std())[:, :, None]
        return u

    return _pixels(edit)


def _breathing(share: float, period_s: float, views: tuple[int, ...]) -> Callable[[Scene], None]:
    """Images grow and shrink about their centre, as with a lens that searches for its focus."""

    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        centre, phase = (np.array(_SIZE) - 1) / 2, 2 * np.pi * (np.arange(len(u)) / scene.fps / period_s + scene.rng.random())
        u, grown = u.copy(), (1 + share * np.sin(phase))[:, None, None, None]
        u[:, :, list(views)] = centre + grown * (u[:, :, list(views)] - centre)
        return u

    return _pixels(edit)


def _jittering(seconds: float) -> Callable[[Scene], None]:
    """The time stamp of each pair of images has a random error with the standard deviation `seconds`."""

    def apply(scene: Scene) -> None:
        late_s = scene.rng.normal(0, seconds, scene.frames)
        scene.camera_late_s = (late_s, late_s)

    return apply


def _backlash(size_mm: float) -> Callable[[Scene], None]:
    """Along each axis the report shifts by `size_mm` when the robot reverses its direction."""
    return _report(lambda scene, t, x: x + 0.5 * size_mm * np.sign(np.gradient(gaussian_filter1d(x, 4, axis=0), axis=0)))


def _flange(length_mm: float) -> Callable[[Scene], None]:
    """The robot reports points `length_mm` behind the landmarks, as if the length of its tool were not set."""

    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        along = x[:, 1:].mean(axis=1) - x[:, 0]
        return x - length_mm * (along / np.linalg.norm(along, axis=1, keepdims=True))[:, None]

    return _report(edit)


def _holding(seconds: float) -> Callable[[Scene], None]:
    """The robot's log repeats each position for the given time."""

    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        every = round(seconds / np.median(np.diff(t)))
        return x[np.arange(len(x)) // every * every]

    return _report(edit)


def _exchanged_later(scene: Scene, u: np.ndarray) -> np.ndarray:
    """From a random frame in the middle of the recording on, left and right are exchanged."""
    u, first = u.copy(), round(scene.rng.uniform(0.3, 0.7) * len(u))
    u[first:] = u[first:, :, ::-1].copy()
    return u


def _gap(share: float) -> Callable[[Scene], None]:
    """The log lacks a stretch, which is filled by linear interpolation."""

    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        seconds = scene.frames / scene.fps
        first = scene.rng.uniform(0, (1 - share) * seconds)
        rows = np.flatnonzero((t >= first) & (t < first + share * seconds))
        part = np.linspace(0, 1, len(rows))[:, None, None]
        x = x.copy()
        x[rows] = (1 - part) * x[rows[0]] + part * x[rows[-1]]
        return x

    return _report(edit)


def _bend(size: float) -> Callable[[Scene], None]:
    """The reported tips are shifted towards the middle of the field by the share `size` of their distance from it."""

    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        x, middle = x.copy(), x.reshape(-1, 3).mean(axis=0)
        x[:, 1:] -= size * (x[:, 1:].mean(axis=1, keepdims=True) - middle)
        return x

    return _report(edit)


def _slip(size_mm: float) -> Callable[[Scene], None]:
    """In the second half the tool has slipped along its shaft by `size_mm`, and the robot's report is wrong by this."""

    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        along = x[:, 1:].mean(axis=1) - x[:, 0]
        along *= size_mm / np.linalg.norm(along, axis=1, keepdims=True) * (t > scene.frames / scene.fps / 2)[:, None]
        return x + along[:, None]

    return _report(edit)


def _order(order: tuple[int, int, int]) -> Callable[[Scene], None]:
    return _report(lambda scene, t, x: x[:, list(order)])


def _move(degrees: float) -> Callable[[Scene], None]:
    def apply(scene: Scene) -> None:
        turn = scene.rng.normal(size=3)
        turn *= np.deg2rad(degrees) / np.linalg.norm(turn)
        shift = scene.rng.normal(0, 0.1 * degrees, 3)
        scene.move = (float(scene.rng.uniform(0.3, 0.7)), RigidTransform.from_rotation_vector(turn, shift))

    return apply


def _spikes(share: float) -> Callable[[Scene], None]:
    """Single samples of the robot have errors of a few millimetres."""

    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        return x + (scene.rng.random((len(x), 1, 1)) < share) * scene.rng.normal(0, 3.0, (len(x), 1, 3))

    return _report(edit)


def _opened(factor: float) -> Callable[[Scene], None]:
    """In the log the tips are `factor` times as far apart, as if half the opening angle were taken for the whole."""

    def edit(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        middle = x[:, 1:].mean(axis=1, keepdims=True)
        return np.concatenate([x[:, :1], middle + factor * (x[:, 1:] - middle)], axis=1)

    return _report(edit)


def _of_cameras(change: Callable[[Camera], Camera], views: tuple[int, ...] = (0, 1)) -> Callable[[StereoRig], StereoRig]:
    return lambda rig: StereoRig(*(change(c) if view in views else c for view, c in enumerate((rig.left, rig.right))))


def _lens(strength: float) -> Callable[[Camera], Camera]:
    """Pixels at the corner move outwards by `strength` of their distance from the centre."""
    centre = (np.array(_SIZE) - 1) / 2
    k = strength / (centre**2).sum()
    return lambda c: NearAffineCamera(c.matrix, getattr(c, "inverse_distance_per_mm", 0.0), centre, radial_per_px2=k)


def _squeezed(factor: float) -> Callable[[Camera], Camera]:
    """The width of the image is multiplied by `factor`."""
    return lambda camera: replace(camera, matrix=camera.matrix * [[factor], [1.0]])


def _changing(zoom: float, degrees: float) -> Callable[[Scene], None]:
    """Both images zoom and rotate about their centre at constant speed, by `zoom` and `degrees` over the recording."""

    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        part, centre = np.linspace(0, 1, len(u)), (np.array(_SIZE) - 1) / 2
        turn = Rotation.from_euler("z", part[:, None] * degrees, degrees=True).as_matrix()[:, None, None, :2, :2]
        return centre + (1 + zoom * part[:, None, None, None]) * (turn @ (u - centre)[..., None])[..., 0]

    return _pixels(edit)


def _of_another(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The log is that of another recording with this robot."""
    other = Scene(np.random.default_rng(scene.rng.integers(1 << 30)), frames=scene.frames, fps=scene.fps)
    return x.mean(axis=(0, 1)) + other.path()(t)


def _repeats(view: int, share: float) -> Callable[[Scene], None]:
    """One camera delivers some images twice."""

    def edit(scene: Scene, u: np.ndarray) -> np.ndarray:
        u = u.copy()
        for i in range(1, len(u)):
            if scene.rng.random() < share:
                u[i, :, view] = u[i - 1, :, view]
        return u

    return _pixels(edit)


def _late(view: int, seconds: float) -> Callable[[Scene], None]:
    return _set(camera_late_s=(seconds, 0.0) if view == 0 else (0.0, seconds))


_SWAP = _pixels(lambda scene, u: u[:, :, ::-1].copy())
_MIRROR = _pixels(lambda scene, u: (_SIZE[0] - 1, 0) + u * (-1, 1))
_REVERSE = _report(lambda scene, t, x: x[::-1].copy())



def _blank(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """One per cent of the robot's samples are missing."""
    return np.where(scene.rng.random((len(x), 1, 1)) < 0.01, np.nan, x)


def _spike(scene: Scene, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """One sample of the robot is off by 1.3 mm in each coordinate."""
    x = x.copy()
    x[scene.rng.integers(200, len(x) - 200)] += 1.3
    return x


#: (fault, strength) -> (names of the hypotheses that are right, function that spoils a scene).
SPOILED: dict[tuple[str, str], tuple[tuple[str, ...], Callable[[Scene], None]]] = {
    **{("clock", f"{ms} ms"): (("clock",), _set(offset_s=ms / 1e3)) for ms in (-20, 183, 383)},
    ("tips exchanged", "both images"): (("tip_order",), _tips((0, 1), 1.0)),
    ("tips exchanged", "left image"): (("tip_order",), _tips((0,), 1.0)),
    ("tips exchanged", "half of the frames"): (("tip_order",), _tips((0, 1), 0.5)),
    **{("z scaled", f"{s}"): (("scaled_axis",), _scale((1, 1, s))) for s in (1.2, 0.5, 2.0)},
    **{("rigid tips", f"{w} mm"): (("rigid_tips",), _both(_set(opening_mm=(0.3, 0.3 + w)), _report(_rigid)))
       for w in (0.5, 1.0, 2.0)},
    **{("random detections", f"{s} px"): (("detector_unfit",), _wrong(1.0, (s,))) for s in (25.0, 50.0, 150.0)},
    **{("foreign pictures", f"{n} frames"): (("detector_unfit", ""), _both(_set(frames=n, fps=2.0), _wrong(0.5)))
       for n in (2, 4, 6)},
    ("no detection", ""): (("detector_unfit",), _pixels(lambda scene, u: np.full_like(u, np.nan))),
    **{("detector partly wrong", f"{100 * s:.0f} %"): (("detector_unfit",), _wrong(s)) for s in (0.35, 0.5, 0.65)},
    **{("read-out time left at 0", f"{1e3 * s:.0f} ms"): (("readout",), _set(readout_s=s, stated_readout_s=0.0))
       for s in (0.010, 0.020, 0.035)},
    **{("axis mirrored", "xyz"[a]): (("mirrored_axis",), _scale(tuple(1 - 2 * np.eye(3)[a]))) for a in range(3)},
    ("eyes exchanged", ""): (("exchanged_eyes",), _SWAP),
    ("both images mirrored", "and the tips exchanged"): (("mirrored_images",), _MIRROR),
    **{("landmark offset", f"{s} mm"): (("landmark_offset",), _offset(k, s)) for k, s in enumerate((0.3, 0.5, 1.0))},
    **{("finite distance", f"{d} mm"): (("finite_distance",), _set(inverse_distance_per_mm=1 / d)) for d in (300, 150, 75)},
    **{("bad landmark", f"{s} px"): (("bad_landmark",), _one_landmark(k, s, 0.8)) for k, s in enumerate((10.0, 40.0, 150.0))},
    **{("bad stretch", f"{s} px"): (("bad_stretch",), _stretch(0.25, s)) for s in (10.0, 40.0, 150.0)},
    **{("camera moved", f"{d} degrees"): (("camera_moved",), _move(d)) for d in (0.3, 1.0, 5.0)},
    **{("kinematics frozen", f"{100 * s:.0f} %"): (("frozen_kinematics",), _frozen(s)) for s in (0.1, 0.25, 0.5)},
    ("left camera late", "40 ms"): (("camera_clock",), _late(0, 0.04)),
    ("right camera late", "100 ms"): (("camera_clock",), _late(1, 0.1)),
    ("images creep", "20 px"): (("drift",), _set(drift_px=20.0)),
    ("frames twice", "30 %"): (("frozen_video",), _frozen_video(0.3)),
    ("frames all the same", ""): (("frozen_video",), _frozen_video(1.1)),
    ("frames out of order", "within 6"): (("frame_order", "detector_unfit", "clock"), _shuffled(6)),
    ("time runs backwards", ""): (("frame_order", "clock"), _REVERSE),
    ("frame rate wrong", "25 for 30"): (("clock_rate", "clock"), _set(rate=1.2)),
    ("log with a gap", "30 %"): (("bad_stretch", "frozen_kinematics"), _gap(0.3)),
    ("tool bends", "3 %"): (("tool_bends",), _bend(0.03)),
    ("tool bends", "10 %"): (("tool_bends",), _bend(0.10)),
    ("base taken for a tip", ""): (("tip_order",), _order((1, 0, 2))),
    ("robot noise", "100 um"): (("robot_noise",), _set(robot_mm=0.1)),
    **{("spikes in the log", f"{100 * s:.0f} %"): (("log_spikes",), _spikes(s)) for s in (0.02, 0.1, 0.3)},
    **{("tips too near or far apart", f"{s}"): (("jaw_opening",), _opened(s)) for s in (0.5, 1.5, 2.0)},
    **{("lens distorts", f"{100 * s:.0f} %"): (("lens_distortion",), _set(edit_rig=_of_cameras(_lens(s))))
       for s in (-0.03, 0.03, 0.1)},
    **{("tool slips", f"{s} mm"): (("tool_slipped",), _slip(s)) for s in (0.1, 0.5, 2.0)},
    ("log of another recording", ""): (("robot_noise",), _report(_of_another)),
    **{("cameras change steadily", f"{100 * zoom:.0f} %, {turn} degrees"): (("drift",), _changing(zoom, turn))
       for zoom, turn in ((0.02, 0.0), (0.0, 2.0), (0.1, -5.0))},
    ("images sorted as text", ""): (("frame_order",), _pixels(_sorted_as_text)),
    **{("log smoothed", f"{s} s"): (("smoothed_log", "robot_noise"), _smoothed(s)) for s in (0.4, 0.8)},
    ("one camera repeats frames", "left, 30 %"): (("frozen_video",), _repeats(0, 0.3)),
    ("one camera repeats frames", "right, 10 %"): (("frozen_video",), _repeats(1, 0.1)),
    ("left image sways", "4 px, each frame"): (("image_sways",), _swaying(4.0, (0,))),
    ("right image sways", "8 px, slowly"): (("image_sways",), _swaying(8.0, (1,), 4.0)),
    ("microscope sways", "6 px, each frame"): (("robot_noise",), _swaying(6.0, (0, 1))),
    ("microscope sways", "12 px, slowly"): (("robot_wanders", "robot_noise"), _swaying(12.0, (0, 1), 4.0)),
    ("lenses breathe", "1 %"): (("zoom_varies",), _breathing(0.01, 1.7, (0, 1))),
    ("left lens breathes", "2 %"): (("zoom_varies",), _breathing(0.02, 0.9, (0,))),
    **{("frames stamped apart", f"{1e3 * s:.0f} ms"): (("time_stamps", "frame_order"), _jittering(s))
       for s in (0.02, 0.06)},
    ("robot has backlash", "0.1 mm"): (("backlash",), _backlash(0.1)),
    ("eyes exchanged later", ""): (("exchanged_eyes",), _pixels(_exchanged_later)),
    ("clock", "3 s"): (("clock",), _set(offset_s=3.0)),
    **{("tool length not set", f"{mm} mm"): (("landmark_offset",), _flange(mm)) for mm in (12, 25)},
    ("log holds positions", "80 ms"): (("time_stamps", "frozen_kinematics"), _holding(0.08)),
}  # fmt: skip

#: Good recordings: sizes, rigs, noise levels, detectors.
GOOD: dict[str, dict[str, object]] = {
    "as usual": {},
    "6 frames": {"frames": 6, "speed_mm_s": 12.0, "fps": 5.0},
    "12 frames": {"frames": 12, "fps": 5.0},
    "30 frames": {"frames": 30},
    "400 frames": {"frames": 400},
    "precise detector": {"noise_px": 0.3},
    "coarse detector": {"noise_px": 4.0},
    "heavy tails": {"tail": 4.0},
    "very heavy tails": {"tail": 2.5},
    "correlated 0.8": {"memory": 0.8},
    "correlated 0.5, heavy tails": {"memory": 0.5, "tail": 4.0},
    "biased detector": {"bias_mm": 0.02},
    "10 % outliers": {"outliers": 0.1},
    "20 % missing": {"missing": 0.2},
    "half missing, 200 frames": {"missing": 0.5, "frames": 200},
    "no covariances": {"stated": False},
    "slow": {"speed_mm_s": 1.5, "frames": 250},
    "fast": {"speed_mm_s": 15.0},
    "wide convergence": {"convergence_deg": 15.0},
    "sparse frames": {"fps": 0.8, "frames": 60},
    "1 % of the log blank": {"edit_report": [_blank]},
    "a spike in the log": {"edit_report": [_spike]},
    "images squeezed by 3 %": {"edit_rig": _of_cameras(_squeezed(0.97))},
    "left image squeezed by 7 %": {"edit_rig": _of_cameras(_squeezed(0.93), (0,))},
    "errors shared by a frame's landmarks": {"shared": 0.5},
}


def takes(recordings: str = "setting", seed: int = 0, only: str = "", distance_mm: float = np.inf) -> Iterator[Take]:
    """First the good, then the spoiled recordings of a set, if their names contain `only`.

    `seed` determines all rigs, tools, paths and noise.  The microscopes have a working distance of `distance_mm`.  If
    it is finite, the recordings whose only fault is a finite distance are left out.
    """
    for i, (name, options) in enumerate(GOOD.items()):
        if only in name:
            rng = np.random.default_rng([SETS[recordings], seed, 1, i])
            yield Scene(rng, inverse_distance_per_mm=1 / distance_mm, **options).take(name)
    for i, ((way, strength), (causes, spoil)) in enumerate(SPOILED.items()):
        if only in way and (np.isinf(distance_mm) or way != "finite distance"):
            scene = Scene(np.random.default_rng([SETS[recordings], seed, 2, i]), inverse_distance_per_mm=1 / distance_mm)
            spoil(scene)
            yield scene.take(way, strength, causes)
