"""``python3 -m lib check RECORDING``: what a recording holds, what is wrong with it, and what to do next, on one page."""

import argparse
import base64
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from lib import files, paths
from lib.calibration.timing import clock_error
from lib.correspondences import LANDMARK_COLOURS, LANDMARKS, of_recording
from lib.landmarks import Detector, SharedDetector, detect
from lib.landmarks.shaft import outlined
from lib.provenance import plain
from lib.recordings import Recording, StereoFrame, encoded
from lib.trust.health import spread
from lib.trust.verdict import LEVELS, LOG_DOUBTS, TEMPLATES, Assessment, assess, report

_COLOURS = np.array([*LANDMARK_COLOURS.values()])
_SHOWN = 3  # number of best frames on the page, and of worst frames
_MOST_FRAMES = 60  # frames to detect in, spread over the recording; more take longer and add little
_SHOWN_PX = 760  # width of one image of an overlay
_USE = "Use it: `python3 -m lib run"


@dataclass(frozen=True, eq=False)
class Check:
    """The result of `check`.  `facts` describe in words the folder, the clock, the read-out, the order of the tips, etc."""

    recording: Recording
    assessment: Assessment
    facts: dict[str, str]
    next_step: str

    def to_json(self) -> dict:
        """The content of check.json: verdict, reasons, next step, facts, numbers, and the score of each frame."""
        a = self.assessment
        hypotheses = [plain({k: v for k, v in vars(h).items() if k != "evidence"}) for h in a.diagnosis.hypotheses[:5]]
        frames = {"frame": a.health.frame.tolist(), "score": plain(a.health.score.tolist())}
        facts = {"recording": self.recording.name, **self.facts, "next_step": self.next_step}
        numbers = {"epipolar_px": plain(a.epipolar_px), "unhealthy_share": a.health.unhealthy}
        return a.verdict.to_json() | facts | numbers | {"diagnosis": hypotheses, "frames": frames}

    def write(self, folder: str | Path) -> Path:
        """Write check.html and check.json into `folder`; returns the path of check.html."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        files.write_json(folder / "check.json", self.to_json())
        a = self.assessment
        text = TEMPLATES.get_template("check.html").render(
            vars(self), verdict=a.verdict, overlays=self._overlays(), coverage=data_uri(self._coverage(), ".png"),
            report="" if a.calibration is None else report(a.calibration, verdict=a.verdict, data=a.data),
            hypotheses=[h for h in a.diagnosis.hypotheses if h.gain > 0][:5],
            shaft=None if a.shaft is None else data_uri(outlined(a.shaft), ".png"),
        )  # fmt: skip
        files.write_text(folder / "check.html", text)
        return folder / "check.html"

    def _overlays(self) -> list[tuple[str, str]]:
        """(caption, picture) of the worst and the best frames."""
        health, data, c = self.assessment.health, self.assessment.data, self.assessment.calibration
        order = np.argsort(-np.nan_to_num(health.score, nan=np.inf), kind="stable")
        found = []
        for place, i in enumerate(dict.fromkeys([*order[:_SHOWN], *order[::-1][:_SHOWN]])):
            number, score = int(health.frame[i]), health.score[i]
            rows = data.of_frames(number)
            detected_px = rows.stacked_px.reshape(-1, 2, 2).swapaxes(0, 1)
            robot_px = None if c is None else np.stack(c.pair.project(rows.x_mm))
            picture = data_uri(overlay(self.recording.frames[number], detected_px, robot_px), ".jpg")
            parts = {name: part[i].max() for name, part in health.parts.items() if np.isfinite(part[i]).any()}
            why = f"score {score:.2g}, from its part {max(parts, key=parts.get)}" if parts else "nothing was found"
            kind = "good" if score <= 1 else "among the worst" if place < _SHOWN else "bad"
            found.append((f"Frame {number} ({kind}): {why}.", picture))
        return found

    def _coverage(self) -> np.ndarray:
        """The figure of coverage as RGB pixels: the tool in the left image, its z over time, the score of each frame."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        data, health = self.assessment.data, self.assessment.health
        figure = Figure(figsize=(11, 3.2), layout="constrained")
        canvas, (field, depth, time) = FigureCanvasAgg(figure), figure.subplots(1, 3)
        for k, name in enumerate(LANDMARKS):
            rows, colour = data.landmark == k, tuple(_COLOURS[k] / 255)
            field.plot(*data.u_left[rows & data.seen[:, 0]].T, ".", ms=4, color=colour, label=name)
            depth.plot(data.time_s[rows], data.x_mm[rows, 2], ".", ms=4, color=colour)
        width, height = self.recording.image_size_px
        field.set(xlim=(0, width), ylim=(height, 0), aspect="equal", title="left image (px)")
        field.legend(fontsize=7)
        depth.set(title="z in the robot frame (mm)", xlabel="time of the video (s)")
        score = np.clip(np.nan_to_num(health.score, nan=1e3), 1e-2, 1e3)
        time.semilogy(self.recording.frames.time_s[health.frame], score, "k.", ms=4)
        time.axhline(1.0, color="#b42318", lw=1)
        limits = min(0.1, 0.8 * score.min(initial=1.0)), max(10.0, 1.2 * score.max(initial=1.0))  # at least two decades
        time.set(title="score of a frame (bad above 1)", xlabel="time of the video (s)", ylim=limits)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3]


def check(recording: str | Path | Recording, *, detector: Callable | None = None, frames: range | None = None) -> Check:
    """Detect landmarks, calibrate, diagnose and judge a recording or some of its `frames`.

    Without `detector`, the one that ships is used; a recording of another tool than a forceps is judged by its labels.
    The ground truth of a recording given by its folder is never opened.  Raises FileNotFoundError or ValueError if the
    recording cannot be read.
    """
    found = recording if isinstance(recording, Recording) else Recording.open(recording, truth=False)
    chosen = range(len(found)) if frames is None else frames
    if found.skeleton == LANDMARKS:
        detector = SharedDetector(detector)
        data = detect(found, detector, frames=np.array(chosen)[spread(len(chosen), _MOST_FRAMES)])
    elif detector is not None:
        raise ValueError(f"detector (--weights): no detector knows {', '.join(found.skeleton)}; leave it out to use labels.")
    elif (marks := found.annotations) is not None:
        data = of_recording(found, marks.u_left, marks.u_right).of_frames(chosen)
    else:
        raise ValueError(f"{found.folder}: the detector only knows {', '.join(LANDMARKS)}, and there are no annotations.")
    a = assess(found.showing(chosen), data, detector=detector)
    step = _next(found, a, chosen).replace("RECORDING", shlex.quote(paths.shown(found.folder)))
    return Check(found, a, _facts(found, a), step)


def _next(recording: Recording, a: Assessment, frames: range) -> str:
    """The next step, in words.  Wrong time stamps come first where there is no calibration or no specific cause."""
    best = a.diagnosis.best
    vague = "detector_unfit", "one_eye_unfit", "robot_noise", "robot_wanders"
    unspecific = a.calibration is None or (best is not None and best.name in vague)
    unspecific |= any(doubt.name in LOG_DOUBTS for doubt in recording.doubts)
    if unspecific and a.verdict.is_red and recording.mistimed:
        return recording.mistimed
    if a.verdict.level != LEVELS[0]:
        cures = {reason.name: reason.cure for reason in a.verdict.reasons}  # for this recording
        if best is not None and best.name == "landmark_offset" and "base" in cures:
            return cures["base"]  # the end of the shaft shows that the detector errs
        return a.verdict.reasons[0].cure if best is None else cures.get(best.name, best.cure)
    if len(frames) < len(recording):
        labels = "" if recording.skeleton == LANDMARKS else " --landmarks annotations"
        return f"Use it: `python3 -m lib calibrate RECORDING --frames {frames.start}:{frames.stop}{labels}`."
    return f"{_USE} -p recording RECORDING`."


def _facts(recording: Recording, a: Assessment) -> dict[str, str]:
    """What a user asks first: title -> answer in words."""
    time_s, log, x, c = recording.frames.time_s, recording.kinematics, a.data.complete.x_mm, a.calibration
    clock_s = (0.0, np.inf) if c is None else clock_error(c, a.data, log, recording.offset_s)
    text = TEMPLATES.get_template("facts.txt").render(
        recording=recording, a=a, landmarks=LANDMARKS, film_s=np.ptp(time_s), log_s=np.ptp(log.time_s),
        volume_mm=np.ptp(x, axis=0) if len(x) else None,
        clock_ms=1e3 * np.array(clock_s) if np.isfinite(clock_s[1]) else None,
    )  # fmt: skip
    return dict(line.split(": ", 1) for line in text.rstrip().split("\n"))


def overlay(frame: StereoFrame, seen: np.ndarray, told: np.ndarray | None, width_px: int = _SHOWN_PX) -> np.ndarray:
    """Both images side by side, RGB: rings at detections `seen` (2, k, 2) px, crosses at the robot's, `told` (2, k, 2) px."""
    images = []
    for side, image in enumerate((frame.left, frame.right)):
        scale = width_px / image.shape[1]
        picture = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for k in range(seen.shape[1]):
            for colour, width in ((255, 255, 255), 3), (_COLOURS[k % 3].tolist(), 2):
                if np.isfinite(seen[side, k]).all():
                    cv2.circle(picture, np.rint(seen[side, k] * scale).astype(int), 9, colour, width, cv2.LINE_AA)
                if told is not None and np.abs(told[side, k]).max() < 1e5:  # neither NaN nor far outside
                    at = np.rint(told[side, k] * scale).astype(int)
                    cv2.drawMarker(picture, at, colour, cv2.MARKER_CROSS, 18, width, cv2.LINE_AA)
        images.append(picture)
    return np.hstack([images[0], np.full((len(images[0]), 6, 3), 255, np.uint8), images[1]])


def data_uri(image: np.ndarray, suffix: str) -> str:
    """An RGB image as a data URI, which a page can embed."""
    text = base64.b64encode(encoded(image, suffix)).decode("ascii")
    return f"data:image/{'jpeg' if suffix == '.jpg' else 'png'};base64,{text}"


def main(argv: list[str]) -> int:
    """`python3 -m lib check`; exit code 0 for a finished check with any verdict, 2 if the folder cannot be read."""
    parser = argparse.ArgumentParser(prog="python3 -m lib check", description="Is this recording fit for use; if not, why?")
    parser.add_argument("recording", type=Path, help="the recording's folder")
    parser.add_argument("--weights", metavar="FILE", help="weights of the detector (default: those that ship)")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for check.html and check.json (default: runs/check-NAME)")
    parser.add_argument("--frames", metavar="A:B", help="check the frames A to B - 1 only; --frames=-10: takes the last ten")
    a = parser.parse_args(argv)
    recording = Recording.open(a.recording, truth=False)
    some = {"frames": recording.frames_of(a.frames)} if a.frames else {}
    part = "".join(f"-{frames.start}-{frames.stop}" for frames in some.values())
    out = a.out or paths.results_folder(f"check-{a.recording.resolve().name}{part}", a.recording)
    found = check(recording, detector=Detector.load(a.weights) if a.weights else None, **some)
    if a.weights:  # only notebook 07 takes other weights than those that ship
        weights = shlex.quote(a.weights)
        step = found.next_step.replace(_USE, f"{_USE} 07 -p weights {weights}")
        found = replace(found, next_step=step.replace("lib calibrate", f"lib calibrate --weights {weights}"))
    print(f"{found.assessment.verdict}\nNext: {found.next_step}\nReport: {found.write(out)}")
    return 0
