"""Detect, calibrate, project the robot's landmarks, train, and again, until the frames for stopping agree no better."""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from lib import files, paths
from lib.adapt.candidates import choose
from lib.adapt.judging import (
    CONFIRMED,
    Agreement,
    agreement,
    better,
    check_base,
    epipolar_px,
    frame_means,
    sd_share,
    stretches,
)
from lib.adapt.looking import at_rest, exchanged_tips, look_elsewhere
from lib.adapt.teacher import LABEL, OtherBaseError, RefusalError, Teacher, longest_still, teach
from lib.calibration import Calibration
from lib.correspondences import LANDMARKS
from lib.landmarks import Detector, SharedDetector
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.recorded import Seen, look
from lib.landmarks.shaft import ShaftEnd, shaft_axis, shaft_end
from lib.provenance import Provenance, plain
from lib.recordings import Recording, smoothed
from lib.recordings.annotations import CLICK_SD_PX, read_coco
from lib.training.samples import LabelledImage
from lib.training.shards import simulated_like
from lib.training.stages import finetune
from lib.trust.footage import turned_images
from lib.trust.health import spread

#: Most rounds of training, and most steps of each network in a round; usually the time ends a training before.
ROUNDS, STEPS = 3, 4000
RECIPE = 42  # version of teaching and training; intermediate results of other versions are not used
#: Share of the remaining time that a round takes, and fewest images for stopping that suffice to fit the error models.
_ROUND_SHARE, _DOUBT_IMAGES = 0.85, 10
#: Note if more than half of the log was not smoothed.
_UNSMOOTHED = (
    "The robot's log was not smoothed: it is short, repeats samples, is too slow for the motion, or is noisier than the "
    "{:.2g} um of robot_accuracy_mm in recording.toml. Log faster, or correct that number."
)
#: Most stereo frames that are used, spread over the recording.
_MOST_FRAMES = 96
#: Relative change of the mean distance from the robot in the frames for stopping.  A round that gains less than this is the
#: last, and one that loses more is not kept.  Those frames are few, so the frames for judging decide.
_LEAST_GAIN = 0.03
#: Least gain on the frames for judging, in its standard deviations, if new weights are kept.  The epipolar distance, which
#: does not depend on the robot, must improve as well.
_SURE_GAIN = 1.0
#: Most rounds of detection near the robot's landmarks before any training, and the share of the tool's length by which the
#: robot's landmarks must move for another such round.
_GUIDED, _SETTLED = 3, 0.01
_ANGLED = np.cos(np.radians(12.0))  # the jaws are angled if the cosine between shaft and tips is smaller
_OVERRULE = 5  # fewest labelled pairs that overrule the detector
_UNSURE = 0.01  # standard deviation of the robot's labels, as a share of the tool's length, above which it asks for clicks
_VAGUE = 0.05  # largest standard deviation of a landmark that no label set by hand gives, as a share of the tool's length
#: Largest median distance of a teacher from labels set by hand: a share of the tool's length, at least twice that of clicks.
_OFF_LABELS, _OFF_LABELS_PX = 0.015, 2 * 1.18 * CLICK_SD_PX


@dataclass(frozen=True, eq=False)
class Adaptation:
    """The result of `adapt`.

    Attributes:
        detector: The adapted one if `improved`, else the one that was given.
        calibration: From detections in the frames for learning; None if the recording could not teach.
        report: The content of report.json.
        improved: True if the frames for judging agree better, both with the robot and between the two images.
        frames: Numbers of the frames for learning, stopping and judging ("learn", "stop", "judge").
        after, seen, told: In the frames for judging: the agreement of the adapted detector with the robot, the detections
            before and after, and the robot's landmarks (m, 2, 3, 2) px.
        shaft: Where the shaft ends; None if the pictures do not show it clearly, or labels set by hand give the base.
    """

    detector: Callable
    calibration: Calibration | None
    report: dict
    improved: bool
    frames: dict[str, np.ndarray]
    after: Agreement | None = None
    seen: tuple[Seen, ...] = ()
    told: np.ndarray | None = None
    shaft: ShaftEnd | None = None


def adapt(
    recording: Recording | str | Path, detector: Detector | None = None, *, labels: str | Path | None = None,
    minutes: float = 20.0, seed: int = 0, folder: str | Path | None = None, progress: bool = True,
    tune: Callable[..., Detector] = finetune,
) -> Adaptation:  # fmt: skip
    """Train the detector on landmarks that the robot labels; the ground truth of a simulated recording is never opened.

    The frames are split into three stretches of time: for learning (training), stopping (validation) and judging (test).

    Args:
        recording: A recording of a forceps, with kinematics.
        detector: The detector to start from; None is the one that ships.
        labels: COCO keypoints like annotations.json; ten labelled pairs are a start if the detector finds too little.
        minutes: Duration of the training; detection and judging add a little.
        seed: Of all random choices.
        folder: Keeps intermediate results, from which the same call continues after a kill; None is runs/adapt-NAME.
        progress: Whether to print progress and the remaining minutes to the error stream.
        tune: Trains a detector further on labelled images, with the arguments of `lib.training.stages.finetune`.

    Raises:
        FileNotFoundError, ValueError: If the folder or the labels cannot be read.
    """
    if not isinstance(recording, Recording):
        recording = Recording.open(recording, truth=False)
    log, noise_mm = smoothed(recording.kinematics, accuracy_mm := recording.robot_accuracy_mm)
    unchanged = (log.x_mm == recording.kinematics.x_mm)[np.isfinite(log.x_mm)].mean()
    recording = replace(recording, truth=None, kinematics=log, robot_accuracy_mm=noise_mm)
    work = _Work(recording, detector, labels, seed, folder, minutes, progress, tune)
    if accuracy_mm and unchanged > 0.5:
        work.report["notes"].append(_UNSMOOTHED.format(1e3 * accuracy_mm))
    try:
        return work.adapted()
    except RefusalError as refused:
        work.report |= {"improved": False, "reason": str(refused)}
        if mistimed := recording.mistimed:  # then the other findings may be wrong
            work.report |= {"reason": f"{mistimed} If that is meant: {refused}", "notes": []}
        return Adaptation(work.detector, None, work.finished(), False, {})


class _Work:
    """An adaptation in progress: the recording, the files with intermediate results, the time left, the report so far."""

    def __init__(
        self, recording: Recording, detector: Callable | None, labels: str | Path | None, seed: int,
        folder: str | Path | None, minutes: float, progress: bool, tune: Callable[..., Detector],
    ) -> None:  # fmt: skip
        self.recording, self.seed, self.progress, self.tune = recording, seed, progress, tune
        self.detector = detector or Detector.load()
        self.minutes, self.saved_s = minutes, 0.0
        self.parts: dict[str, np.ndarray] = {}  # frames for learning, stopping and judging
        self.whole: Seen  # the detections that taught first, without the robot's report
        self.shaft: ShaftEnd | None = None
        self.axis: np.ndarray | None = None  # of the shaft, in the tool's axes
        self.knows_base = True  # False: the detector marks another point for the base
        self.simulated: list[LabelledImage] = []  # simulated frames in the colours of this recording
        self.labels = np.full((len(recording), 2, 3, 2), np.nan)
        if labels is not None:
            given = read_coco(Path(labels), len(recording), recording.image_size_px, recording.skeleton)
            self.labels = np.stack([given.u_left, given.u_right], axis=1)
        self.marked = np.flatnonzero(np.isfinite(self.labels).any(axis=(1, 2, 3)))
        self.frames = np.union1d(spread(len(recording), _MOST_FRAMES), self.marked)
        kept = self.marked[spread(len(self.marked), max(len(self.frames) - 20, 5))]  # the rest count as unlabelled
        self.labels[np.setdiff1d(self.marked, kept)], self.marked = np.nan, kept
        self.learns = isinstance(self.detector, Detector)  # other callables have no networks
        self.looks_near = self.learns and bool(self.detector.closeup_network)
        digest = getattr(self.detector, "digest", "")  # of the detector that learns
        arrays = recording.kinematics.x_mm, recording.kinematics.time_s, recording.frames.time_s, self.frames
        key = [str(recording.folder.resolve()), digest, *(array.tobytes() for array in arrays)]
        key += [RECIPE, STEPS, seed, minutes, recording.offset_s, recording.readout_s, recording.robot_accuracy_mm]
        pairs = (recording.frames[int(i)] for i in self.frames[::12])  # changed images in the same folder need new work
        key += [labels and Path(labels).read_bytes(), *(files.digest(p.left.tobytes(), p.right.tobytes()) for p in pairs)]
        self.folder = work_folder(folder, recording.name, key)
        self.folder.mkdir(parents=True, exist_ok=True)
        state = self.folder / "state.json"
        spent_s = json.loads(state.read_text(encoding="utf-8"))["seconds"] if state.is_file() else 0.0
        self.began, self.provenance = time.perf_counter() - spent_s, Provenance("python3 -m lib adapt")
        self.report: dict = {"recording": recording.name, "weights": digest[:12], "minutes": minutes, "seed": seed}
        self.report |= {"notes": [], "rounds": []}

    @property
    def left_min(self) -> float:
        return max(self.minutes - (time.perf_counter() - self.began) / 60, 0.0)

    def finished(self) -> dict:
        """The report with its provenance."""
        return plain(self.provenance.so_far() | self.report)

    def look(self, name: str, detector: Callable, frames: np.ndarray, near: np.ndarray | None = None) -> Seen:
        """Detections by `look`, or those that an earlier call kept under this name."""
        asked = SharedDetector(detector) if near is None and self.learns else detector
        return self.kept(name, partial(look, self.recording, asked, frames, near=near))

    def moving(self, seen: Seen, detector: Detector) -> Seen:
        """`seen`; tools that stand still while the robot moves are replaced by other detections."""
        still = at_rest(seen, self.recording.landmarks_mm()[seen.frame])
        if not still.any() or not self.learns or detector.tool_network is None:
            return seen
        self.report["notes"].append(
            f"In {still.sum()} of {still.size} images the detected tool stands still while the robot moves: it is another "
            "object, or a pattern. There detection was repeated only where the image differs from the ground."
        )
        return self.kept("elsewhere", partial(look_elsewhere, self.recording, detector, seen, still))

    def kept(self, name: str, find: Callable[..., Seen]) -> Seen:
        """Detections by `find`, or those that an earlier call kept under this name."""
        path = self.folder / f"{name}.npz"
        if not path.is_file():
            found = find(title=f"Detecting ({name}), at most {self.left_min:.1f} min of training left" * self.progress)
            with files.whole(path) as new:
                np.savez(new, **found._asdict())
        with np.load(path) as kept:
            return Seen(*(kept[field] for field in Seen._fields))

    def images(self, frames: np.ndarray, teacher: Teacher, seen: Seen | None) -> list[LabelledImage]:
        """Left and right images with the teacher's labels, if these include the base and a tip."""
        found = []
        for number, *labels in zip(frames, *teacher.labels(frames, seen), strict=True):
            frame = self.recording.frames[int(number)]
            for side, u, covariance, visibility in zip(("left", "right"), *labels, strict=True):
                known = np.isfinite(u).all(axis=1) & (visibility > 0)
                if known[0] and known[1:].any():
                    sd_px = np.sqrt(np.nan_to_num(np.trace(covariance, axis1=1, axis2=2), nan=1e6) / 2)
                    found.append(LabelledImage(f"{side} {number}", getattr(frame, side), u, visibility, sd_px))
        return found

    def adapted(self) -> Adaptation:
        """Teach, train and detect again, in rounds, then judge."""
        recording, start, rounds = self.recording, self.detector, self.report["rounds"]
        if turned := turned_images(recording, self.frames):
            raise RefusalError(f"images: {turned.text} {turned.cure}")
        seen = self.moving(first := self.look("before", start, self.frames), start)
        nothing = np.full_like(self.labels, np.nan)
        still, note = longest_still(recording, seen.labelled(self.labels if len(self.marked) < _OVERRULE else nothing))
        self.report["notes"] += [note] if note else []
        self.labels[np.setdiff1d(self.frames, still)], self.marked = np.nan, np.intersect1d(self.marked, still)
        # Few labels only replace the detections of their landmarks.
        by_hand, few = (None, self.labels) if len(self.marked) < _OVERRULE else (Seen.by_hand(self.labels), nothing)
        parts = self.parts = stretches(np.setdiff1d(still, self.marked), recording.frames.time_s, len(self.marked))
        learn = parts["learn"] = np.union1d(parts["learn"], self.marked)
        self.report["frames"] = {name: len(part) for name, part in parts.items()}
        if by_hand is not None and exchanged_tips(first, by_hand):
            raise RefusalError("labels: in most images tip_1 is where the detector sees tip_2. Exchange the two labels.")
        try:
            teacher = self.taught(seen.labelled(few).of(learn), by_hand)
            if self.contradicted(teacher):
                raise RefusalError("labels: detector and robot agree with each other, but not with the labels; check both.")
        except RefusalError as refused:
            if by_hand is None:
                raise
            self.report["notes"].append(f"The cameras are estimated from the labels alone. {refused}")
            teacher = teach(recording, None, by_hand=by_hand)
        self.report["start_share"] = teacher.right
        u, guided = teacher.labels(learn)[0], None
        for k in range(_GUIDED if self.looks_near else 0):  # untrained, near the robot's landmarks
            guided = self.near(f"guided {k}", start, learn, teacher)
            try:
                found = teach(recording, guided.labelled(few), opinion=guided, before=teacher, by_hand=by_hand)
            except RefusalError:
                if by_hand is None:
                    raise
                break  # a detector that does not know the tool cannot improve on labels set by hand
            if self.contradicted(found):
                break
            teacher = found
            u, last = teacher.labels(learn)[0], u
            moved = np.linalg.norm(u - last, axis=-1) / tool_length_px(u)[..., None]
            if np.nanmax(np.nanmedian(moved, axis=(0, 1))) < _SETTLED:
                break
        if by_hand is None:  # else the labels tell where the base is
            if (sd := sd_share(teacher, learn)).max() > _VAGUE:
                what = f"{LANDMARKS[sd.argmax()]} only to {100 * sd.max():.0f} % of the tool's length (standard deviation)"
                raise RefusalError(f"detector: with the robot it gives {what}. {LABEL}")
            self.shaft = shaft_end(recording, learn, u[:, :, 0], teacher.axes_px(learn))
            doubted = not (self.knows_base and teacher.agrees_on_base)
            if doubted and (self.shaft is None or abs(self.shaft.moved) > CONFIRMED):
                base = "the robot reports" if self.knows_base else "was searched instead, at these angled jaws,"
                what = f"it marks another point than the base, and the base that {base}"
                raise RefusalError(f"detector: {what} is not where the aligned frames show the end of the shaft. {LABEL}")
            moved, teacher = teacher, teacher.with_base(self.shaft)
            shift_mm = teacher.offset_mm[0] - moved.offset_mm[0]
            self.report["base_moved_mm"] = 0.0 if self.shaft is None else float(shift_mm @ self.shaft.axis)
            aside = self.shaft and self.shaft.aside
            self.report["base_moved_aside_mm"] = 0.0 if aside is None else float(shift_mm @ aside.axis)
            if self.looks_near and self.knows_base:
                check_base(teacher, self.whole.of(np.setdiff1d(learn, teacher.refused)), self.shaft)
        self.report["refused_frames"] = teacher.refused
        agreement(teacher, first.of(parts["judge"]), fewest=3)  # else training is in vain
        best, best_seen, stop = start, first, agreement(teacher, first.of(parts["stop"])).summary()
        rounds.append({"round": 0, "right": teacher.right} | stop)
        some = learn[:: max(1, len(learn) // 8)]
        self.simulated = simulated_like((recording.frames[int(i)].left for i in some), self.seed, self.progress)
        for k in range(1, ROUNDS + 1):
            begun = (self.folder / f"round {k}").is_dir()  # before a kill
            if k > 1 and not begun and self.left_min < 0.1 * self.minutes:
                break
            tuned = self.round(k, best, teacher, None if k == 1 else best_seen)
            seen, refusal = self.look(f"round {k}", tuned, self.frames), {}
            try:
                part = seen.labelled(few).of(learn)
                found = teach(recording, part, before=teacher, opinion=guided, by_hand=by_hand).with_base(self.shaft)
                new = teacher if self.contradicted(found) else found
            except RefusalError as refused:
                refusal = {"refused": str(refused)}
                if by_hand is None:
                    rounds.append({"round": k} | refusal)
                    break
                new = teacher  # which rests on labels set by hand
            now = agreement(new, seen.of(parts["stop"])).summary()
            rounds.append({"round": k, "right": new.right} | now | refusal)
            last = now["mean_share"] > (1 - _LEAST_GAIN) * stop["mean_share"]
            if now["mean_share"] <= (1 + _LEAST_GAIN) * stop["mean_share"]:
                best, best_seen, teacher, stop = tuned, seen, new, now
            if last:
                break
        return self.judged(first, best, best_seen, teacher)

    def taught(self, seen: Seen, by_hand: Seen | None) -> Teacher:
        """The first teacher, by the detections or, if they do not teach, by those candidates that move with the robot."""
        self.whole = seen
        try:
            return self.with_any_base(seen, by_hand)
        except RefusalError as refused:
            if by_hand is not None or not self.looks_near:
                raise
            self.whole = chosen = self.kept("chosen", partial(choose, self.recording, self.detector, seen, self.seed))
            self.axis = None  # it may rest on wrong cameras
            try:
                teacher = self.with_any_base(chosen.labelled(self.labels), None, name="base of the chosen")
            except RefusalError:
                raise refused from None
            # Frames that do not show the robot's tool in both images may belong to other instants.
            found = np.isfinite(chosen.u).all(axis=3).any(axis=2).all(axis=1)
            teacher = replace(teacher, refused=np.union1d(teacher.refused, chosen.frame[~found]))
            self.report["notes"].append(
                f"The detections do not teach ({str(refused).partition('. ')[0]}). So the robot's motion chose among several "
                f"candidates in each image: {100 * np.isfinite(chosen.u).all((2, 3)).mean():.0f} % of the images show one."
            )
            return teacher

    def with_any_base(self, seen: Seen, by_hand: Seen | None, name: str = "base") -> Teacher:
        """A first teacher.  The detector may mark the kink of angled jaws, or a ring on the shaft, instead of the base.

        Then the tips alone give the cameras, and the base is detected near the robot's; `name` is that of these detections.
        Labels set by hand tell where the base is, so with them nothing else is tried.
        """
        try:
            return teach(self.recording, seen, by_hand=by_hand)
        except RefusalError as refused:
            if not self.looks_near or by_hand is not None:
                raise
            try:
                tips = teach(self.recording, seen._replace(confidence=seen.confidence * [0.0, 1.0, 1.0]))
                near = self.near(name, self.detector, seen.frame, tips)
                teacher = teach(self.recording, seen.with_base(near))
            except RefusalError:
                raise refused from None
            if not isinstance(refused, OtherBaseError):
                return replace(teacher, agrees_on_base=False)
            if self.axis[0] > _ANGLED:
                raise
            self.knows_base = False
            self.report["notes"].append(
                f"The shaft points {np.degrees(np.arccos(self.axis[0])):.0f} degrees away from the tips, and the detector "
                "marks another point than the base, perhaps the kink of the jaws. So the base was searched near the robot's."
            )
            return teacher

    def near(self, name: str, detector: Detector, frames: np.ndarray, teacher: Teacher) -> Seen:
        """Detections near the robot's landmarks; if the jaws are angled, those of the base in windows along the shaft."""
        u, _, shown = teacher.labels(frames)
        seen, axes = self.look(name, detector, frames, u), teacher.axes_px(frames)
        seen = seen._replace(confidence=seen.confidence * (shown > 0))  # at the border something may look like a landmark
        if self.axis is None:
            self.axis = shaft_axis(self.recording, frames, u[:, :, 0], axes)
        if self.axis[0] > _ANGLED:
            return seen
        along = axes @ self.axis
        aside = 0.2 * along[..., ::-1] * [1, -1]  # the windows are those of straight jaws
        straight = u[:, :, :1] + np.stack([0 * along, along + aside, along - aside], axis=2)
        return seen.with_base(self.look(f"{name} along the shaft", detector, frames, straight))

    def contradicted(self, teacher: Teacher) -> bool:
        """True if a teacher's landmarks are too far from labels set by hand."""
        told = teacher.project(self.marked)[0]
        off = np.linalg.norm(told - self.labels[self.marked], axis=-1)
        off /= np.maximum(_OFF_LABELS * tool_length_px(told), _OFF_LABELS_PX)[..., None]
        return len(self.marked) >= _OVERRULE and np.isfinite(off).any() and np.nanmedian(off) > 1

    def round(self, k: int, detector: Detector, teacher: Teacher, seen: Seen | None) -> Detector:
        """The detector trained further on the teacher's labels of the frames for learning."""
        path, parts = self.folder / f"round {k}.safetensors", self.parts
        if path.is_file():
            return Detector.load(path, engine=detector.engine)
        held_out = self.images(parts["stop"], teacher, seen)
        doubt_on = parts["learn"][:0]
        if len(held_out) < _DOUBT_IMAGES:  # frames that were trained on do not show the errors in others, so hold out more
            doubt_on = parts["learn"][3::4]
            held_out += self.images(doubt_on, teacher, seen)
        # The robot's labels have the same error in all frames.  The networks learn it, so it is no noise of held-out labels.
        held_out = [one._replace(sd_px=0.0) for one in held_out]
        late = self.marked[self.marked >= parts["stop"][0]]  # among the frames for judging, so no training sees them
        images = self.images(np.setdiff1d(parts["learn"], np.append(doubt_on, late)), teacher, seen)
        if len(images) < 8 or len(held_out) < 4:
            raise RefusalError(f"robot: it labels {len(images)} images to train on, {len(held_out)} others; 8 and 4 suffice.")
        done = {}

        def progress(stage: str, part: float) -> None:
            done[stage] = part
            shares = ", ".join(f"{name} {100 * one:.0f} %" for name, one in sorted(done.items()))
            share = min(sum(done.values()) / len(detector.networks), 1.0)
            if self.progress:
                line = f"\rRound {k} ({shares}): {100 * share:3.0f} %, at most {self.left_min:.1f} min of training left "
                print(line, end="" if share < 1 else "\n", file=sys.stderr, flush=True)
            if time.perf_counter() - self.saved_s > 30:  # so that a kill loses little of the time count
                self.saved_s = time.perf_counter()
                files.write_json(self.folder / "state.json", {"seconds": self.saved_s - self.began})

        tuned = self.tune(
            detector, images, held_out, self.folder / f"round {k}", simulated=self.simulated, steps=STEPS, seed=self.seed,
            minutes=max(self.left_min * _ROUND_SHARE, 0.05), progress=progress,
        )  # fmt: skip
        if self.learns:
            tuned.save(path)
        files.write_json(self.folder / "state.json", {"seconds": time.perf_counter() - self.began})
        return tuned

    def judged(self, first: Seen, best: Detector, best_seen: Seen, teacher: Teacher) -> Adaptation:
        """Compare both detectors on the frames for judging, which took no part in teaching or stopping.

        Left and right are compared in the frames for stopping, too: these chose a round by the robot, not by left and right.
        """
        seen = first.of(self.parts["judge"]), best_seen.of(self.parts["judge"])
        agreements = [agreement(teacher, own) for own in seen]
        length = agreements[0].length_px.mean(axis=1)
        told, spread = teacher.project(self.parts["judge"])
        untaught = np.union1d(self.parts["stop"], self.parts["judge"])
        both = first.of(untaught), best_seen.of(untaught)
        found, judges = agreement(teacher, both[0]), np.isin(untaught, self.parts["judge"])
        unlabelled = np.isnan(found.distance_px).any(axis=1)  # there a detector may rightly find nothing
        distances = epipolar_px(self.recording, both, best_seen.of(self.parts["learn"]))
        distances = [np.where(unlabelled, np.nan, own) for own in distances]
        robot, robot_sd = better(*(own.relative for own in agreements))
        eye, eye_sd = better(*(frame_means(own / found.length_px.mean(axis=1)) for own in distances))
        improved = best is not self.detector and robot > _SURE_GAIN * robot_sd and eye > 0
        reasons = {
            "no round brought the frames for stopping nearer to the robot; more --minutes may": best is self.detector,
            "on the frames for judging the gain is no larger than its standard deviation": not robot > _SURE_GAIN * robot_sd,
            "without the robot, left and right of these frames and of those for stopping do not agree better": not eye > 0,
            "the frames for judging agree better with the robot; left and right do in these and those for stopping": True,
        }
        labels_sd_px = np.nanmedian(np.sqrt(np.trace(spread, axis1=-2, axis2=-1) / 2), axis=(0, 1))
        unsure = not len(self.marked) and np.nanmax(labels_sd_px) > _UNSURE * np.nanmean(length)
        self.report["notes"].append(
            "The robot's labels in the images have standard deviations of "
            f"{', '.join(f'{sd:.1f}' for sd in labels_sd_px)} px ({', '.join(LANDMARKS)}). Most of that error is the same in "
            "all frames. So neither the agreement with the robot nor the weights' covariance and confidence contain it."
            + f" {LABEL} They determine most of that error." * bool(unsure)
        )
        self.report |= {
            "improved": bool(improved), "reason": next(reason for reason, holds in reasons.items() if holds),
            "judged": {
                name: own.summary() | {"epipolar_px": float(np.nanmedian(distance[judges]))}
                for name, own, distance in zip(("before", "after"), agreements, distances, strict=True)
            },
            "gain": {"robot": [robot, robot_sd], "epipolar": [eye, eye_sd]},
            "offset_s": teacher.recording.offset_s, "clock_sd_s": teacher.clock_sd_s,
            "landmark_offset_mm": teacher.offset_mm,
            "landmark_offset_sd_mm": np.sqrt(np.diagonal(teacher.offset_covariance_mm2, axis1=1, axis2=2)),
            "landmark_offset_turns_axes": teacher.turns,
            "labels_sd_px": labels_sd_px,
            "gauge": "An offset that all landmarks share looks like a shift of the cameras; the standard deviations do not "
            "include it. A robot's offset looks like a constant error of the detector; labels set by hand distinguish them, "
            "and for the base the end of the shaft.",
        }  # fmt: skip
        if improved and self.learns:
            best = replace(best, metadata=best.metadata | {"adapted": self.finished()})
        return Adaptation(
            best if improved else self.detector, teacher.calibration, self.finished(), bool(improved), self.parts,
            agreements[1], seen, told, self.shaft,
        )  # fmt: skip


def work_folder(folder: str | Path | None, name: str, key: list) -> Path:
    """The folder of an adaptation's intermediate results, a separate one for each `key`."""
    return Path(folder or paths.RUNS / f"adapt-{name}") / "work" / files.digest(repr(key).encode())
