"""``python3 -m lib import | detect | calibrate | reconstruct | register``: the stages for users who do not write Python.

Each prints what it did and ends with the verdict of `lib.trust`.  Exit codes: 0; 2 bad input, nothing written; 3 the
verdict is "not trustworthy", so no results that depend on the calibration are written (--force writes them).
"""

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np

from lib import files, paths
from lib.calibration import Calibration, LandmarkOffsets, with_offsets, write_opencv, write_ros
from lib.calibration.models import Model
from lib.cameras import StereoRig
from lib.correspondences import LANDMARKS, Correspondences, of_recording
from lib.importing import guess_mapping, import_recording
from lib.landmarks import Detector, SharedDetector, detect
from lib.matching import RigMisfitError
from lib.matching.rectification import rectify
from lib.recordings import Recording, encoded
from lib.recordings.tables import write_table
from lib.registration import register_images
from lib.surface import Reconstruction, reconstruct, save_map, save_mesh, save_points, surface_mesh
from lib.surface.reconstruct import AMBIGUOUS
from lib.trust import LEVELS, LIMITS, Assessment, Reason, Verdict, assess, report

#: Least number of landmarks for comparing a rig with cameras calibrated from them (fewer are overfitted), and least error.
_FEWEST, _EXACT_PX = 24, 0.5
_NAMED = 8  # most frames that `detect` names


def main_import(argv: list[str]) -> int:
    """`python3 -m lib import`: write a recording from videos, a robot's log and labels, as a mapping file describes them."""
    parser = argparse.ArgumentParser(prog="python3 -m lib import", description=main_import.__doc__.split(": ", 1)[1])
    parser.add_argument("source", type=Path, help="folder of your files; it is never changed")
    parser.add_argument("--map", type=Path, required=True, help="the mapping file (data/README.md lists its keys)")
    parser.add_argument("--guess", action="store_true", help="write a first mapping from the files, and stop")
    parser.add_argument("--out", type=Path, help="the recording to write")
    parser.add_argument("--overwrite", action="store_true", help="replace a recording of that name")
    a = parser.parse_args(argv)
    if a.guess:
        if a.out or a.overwrite:
            parser.error("--out, --overwrite: --guess writes a mapping only; leave them out, and give them without --guess.")
        if a.map.exists():
            raise FileExistsError(f"{a.map}: exists already; choose another name, or remove it.")
        text = guess_mapping(a.source)
        files.write_text(a.map, text)
        again = shlex.join(["python3", "-m", "lib", "import", str(a.source), "--map", str(a.map), "--out", "my_recording"])
        print(f"{text}\nWrote {a.map}. Look at each line that says CHECK, then: {again}")
        return 0
    if a.out is None:
        parser.error("--out: name the recording to write.")
    print("\n".join(import_recording(a.source, a.map, a.out, overwrite=a.overwrite)["did"]))
    recording = Recording.open(a.out)
    print(f"Wrote {a.out}. Next: {shlex.join(['python3', '-m', 'lib', 'check', str(a.out)])}")
    if recording.annotations is not None:
        print(assess(recording, _labelled(recording)).verdict)
    return 0


def main_annotate(argv: list[str]) -> int:
    """`python3 -m lib annotate`: label frames by hand in JupyterLab, the most useful first; writes annotations.json."""
    parser = argparse.ArgumentParser(prog="python3 -m lib annotate", description=main_annotate.__doc__.split(": ", 1)[1])
    parser.add_argument("recording", type=Path, help="folder of a recording")
    folder = Recording.open(parser.parse_args(argv).recording, truth=False).folder.resolve()
    page = paths.RUNS / f"annotate-{folder.name}-{files.digest(str(folder).encode(), length=6)}.ipynb"  # one for each folder
    page.parent.mkdir(exist_ok=True)
    text = json.dumps(json.dumps(str(folder))[1:-1])[1:-1]  # a Python string in JSON
    files.write_text(page, (paths.ROOT / "lib" / "annotate.ipynb").read_text(encoding="utf-8").replace("RECORDING", text))
    lab = [sys.executable, "-m", "lib", "lab", f"--LabApp.default_url=/lab/tree/{paths.RUNS.name}/{quote(page.name)}"]
    return subprocess.call(lab, cwd=paths.ROOT)


def main_detect(argv: list[str]) -> int:
    """`python3 -m lib detect`: find the landmarks in every frame of a recording and write them to landmarks.csv."""
    a, recording, out = _parsed("detect", main_detect, argv)
    data = _data(a, recording)
    _write_landmarks(out / "landmarks.csv", recording, data)
    print(f"{int(data.seen.sum())} of {data.seen.size} landmarks found. Wrote {out / 'landmarks.csv'}.")
    found = _assessed(a, recording, data)
    bad = found.health.frame[found.health.bad.any(axis=1)]
    named = f": look at frames {', '.join(map(str, bad[:_NAMED]))}{' and others' * (len(bad) > _NAMED)}" if len(bad) else ""
    print(f"{found.health.text}{named}.\n{found.verdict}")
    return 0


def main_calibrate(argv: list[str]) -> int:
    """`python3 -m lib calibrate`: both cameras from landmarks and the robot; writes JSON, OpenCV YAML, ROS CameraInfo."""
    a, recording, out = _parsed("calibrate", main_calibrate, argv)
    calibration, offsets, verdict, data = _calibrated(a, recording, out)
    if calibration is None:
        return 3
    print(report(calibration, verdict=verdict, data=data).removeprefix(f"{verdict}\n"))
    _write_landmarks(out / "landmarks.csv", recording, data)
    _write_rig(out, calibration.rig, recording)
    numbers = {"model": calibration.model, "sigma_u_px": calibration.sigma_u_px, "sigma_x_mm": calibration.sigma_x_mm}
    numbers |= {"rows": int(calibration.inliers.size), "rows_used": int(calibration.inliers.sum())}
    numbers |= {"parameters": calibration.parameter_names, "parameter_covariance": calibration.parameter_covariance.tolist()}
    numbers |= {"variations": [other.to_json() | _offsets_entries(own) for other, own in calibration.variations]}
    return _done(a, out, "calibration", numbers | _offsets_entries(offsets), verdict)


def main_reconstruct(argv: list[str]) -> int:
    """`python3 -m lib reconstruct`: the surface in one stereo frame; writes CSV, TIFF, GLB, PLY, the rectified pair."""
    a, recording, out = _parsed("reconstruct", main_reconstruct, argv)
    rig, offsets, verdict, data = _calibrated(a, recording, out)
    if rig is None:
        return 3
    cause = next(iter(verdict.reasons), None)
    frame, now = recording.frames[a.frame], with_offsets(data, offsets).of_frames(a.frame)
    pair = rig.pair if isinstance(rig, Calibration) else rig
    tool = now.tool_px(pair) if recording.skeleton == LANDMARKS and len(now) == len(LANDMARKS) else None
    if tool is None or not np.isfinite(tool).all():
        text, cure = "The surface may include the tool: its mask needs base, tip_1 and tip_2.", "Compare it with the images."
        if recording.skeleton == LANDMARKS:
            text = f"The surface may include the tool, since base and tips are not all known in frame {a.frame}."
            cure = "Choose another frame, or label this one and give --landmarks annotations."
        verdict = Verdict.join([verdict, Verdict((Reason("tool_not_masked", LEVELS[1], text, cure),))])
    try:
        found = reconstruct(frame.left, frame.right, rig, setting=a.setting, u_landmarks=tool)
    except RigMisfitError as error:
        why = f" The recording's verdict says: {cause.text} {cause.cure}" if cause else ""
        raise ValueError(f"{error}{why}") from None
    if found.matches.ambiguous > AMBIGUOUS:
        share = f"{100 * found.matches.ambiguous:.0f} % of the matches"
        text = f"The texture repeats: {share} fit several places, and were dropped."
        cure = "Others may be wrong, too: compare the surface with the images, or show a texture that does not repeat."
        verdict = Verdict.join([verdict, Verdict((Reason("ambiguous_texture", LEVELS[1], text, cure),))])
    x, y = np.clip(np.rint(found.u).astype(int), 0, np.subtract(recording.image_size_px, 1)).T
    names = ["left_x_px", "left_y_px", "right_x_px", "right_y_px", "x_mm", "y_mm", "z_mm", "sd_x_mm", "sd_y_mm", "sd_z_mm"]
    sd_mm = np.sqrt(np.diagonal(found.points.covariance_mm2, axis1=1, axis2=2))  # without the cameras' part
    table = np.hstack([found.u, found.matches.u_right, found.points.x_mm, sd_mm])
    write_table(out / "points.csv", names, table, [4] * len(names))
    try:
        save_mesh(surface_mesh(found.surface, image=frame.left, mask=~found.mask_left), out / "surface.glb")
        save_points(out / "points.ply", found.points.x_mm, colours=frame.left[y, x])
    except ImportError as error:
        print(f"Without surface.glb and points.ply: {error}")
    positions_mm = found.surface.on_grid(*map(np.arange, recording.image_size_px))
    positions_mm[found.mask_left] = np.nan
    save_map(out / "surface.tiff", positions_mm)
    (out / "depth.tiff").unlink(missing_ok=True)  # from an earlier run; without parallel rays there is no depth map
    if found.rig.is_affine:
        save_map(out / "depth.tiff", positions_mm @ found.rig.left.viewing_direction)
    _write_rectified(out, found, frame.left, frame.right)
    found.rig.save(out / "refined_rig.json")  # refined by the matches
    hidden = f"Tool, glints and a dark surround hide {100 * found.mask_left.mean():.0f} % of the left image."
    print(f"Frame {a.frame}: {len(found.u)} points from {found.n_matches} matches. {hidden}")
    numbers = {"frame": a.frame, "points": len(found.u), "matches": found.n_matches, "ambiguous": found.matches.ambiguous}
    if isinstance(rig, Calibration):
        numbers["depth_sd_of_cameras_mm"] = sd_mm = float(np.median(rig.depth_sd_mm(found.points.x_mm)))
        print(f"The cameras' errors shift neighbouring points alike, in depth by {1e3 * sd_mm:.0f} um (sd).")
    return _done(a, out, "reconstruction", numbers, verdict)


def main_register(argv: list[str]) -> int:
    """`python3 -m lib register`: find the calibrated cameras again, after the microscope was moved."""
    a, recording, out = _parsed("register", main_register, argv)
    rig, (*_, offsets, varied) = StereoRig.load(a.rig), _results_of_rig(a.rig, image_size_px=recording.image_size_px)
    data = _data(a, recording)
    seen = with_offsets(data, offsets)
    varied = [(other, with_offsets(data, own)) for other, own in varied]
    found = register_images(rig, seen, sigma_x_mm=recording.robot_accuracy_mm, loss="robust", variations=varied)
    moved, seen = rig.moved(found.transform), seen.complete
    epipolar_px = np.abs(moved.epipolar_distance(seen.u_left, seen.u_right))
    error_mm = np.linalg.norm(moved.triangulate(seen.u_left, seen.u_right).x_mm - seen.x_mm, axis=1)
    medians = [float(np.median(values)) if len(values) else None for values in (epipolar_px, error_mm)]
    anew = _assessed(a, recording, data)
    verdict = Verdict.join([_common_motion(moved, anew, offsets), anew.verdict])
    if _refused(a, out, verdict):
        return 3
    _write_rig(out, moved, recording, "moved_")
    numbers = {"rotation": found.transform.R.tolist(), "translation_mm": found.transform.t.tolist()}
    numbers |= {"covariance": found.covariance.tolist(), "centre_mm": found.centre_mm.tolist()}
    numbers |= {"median_epipolar_px": medians[0], "median_error_mm": medians[1]}
    shift_mm = np.linalg.norm(found.centre_mm - found.transform.inverse().apply(found.centre_mm))
    sd = f"standard deviation {found.translation_sd_mm.max():.3f} mm"
    sd += " with the calibration's error" if varied else " by these detections alone, without the calibration's error"
    print(f"The cameras moved by {shift_mm:.3f} mm at the tool, {sd}.")
    if len(seen):
        print(f"The tool is now {medians[1]:.3f} mm from where it is expected (median).")
    return _done(a, out, "registration", numbers | _offsets_entries(offsets), verdict)


def _assessed(a: argparse.Namespace, recording: Recording, data: Correspondences) -> Assessment:
    return assess(recording.showing(a.frames), data, detector=a.detector, **a.options)


def _offsets_entries(offsets: LandmarkOffsets | None) -> dict:
    """The entries of a result file for the landmarks' offsets."""
    numbers = {"landmark_offsets_mm": offsets and offsets.offset.tolist()}
    return numbers | {"landmark_offsets_turn_axes": offsets and offsets.turns}


def _offsets_of(entries: dict) -> LandmarkOffsets | None:
    """The offsets of `_offsets_entries`; their standard deviations are not among them."""
    offset, turns = entries["landmark_offsets_mm"], bool(entries["landmark_offsets_turn_axes"])
    offset = offset and np.array(offset, dtype=np.float64)
    return None if offset is None else LandmarkOffsets(offset, np.nan * offset, np.nan, np.nan, turns)


def _results_of_rig(
    rig: Path, frame: int = 0, image_size_px: tuple[int, int] | None = None
) -> tuple[str, Verdict, LandmarkOffsets | None, list[tuple[StereoRig, LandmarkOffsets | None]]]:
    """From the result file beside a rig: its recording ("" if not of this frame), its verdict, offsets, and variations.

    A ValueError refuses a rig for images of another size than `image_size_px`, (width, height).
    """
    path = rig.parent / ("registration.json" if rig.name.startswith("moved_") else "calibration.json")
    if not path.is_file():
        return "", Verdict(), None, []
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
        offsets = _offsets_of(results)
        varied = results.get("variations", []) if rig.name == "rig.json" else []  # they are not about a refined rig
        varied = [(StereoRig.of_json(one), _offsets_of(one)) for one in varied]
        own = rig.name in ("rig.json", "moved_rig.json") and "recording" in results
        own = own and frame in range(*results["frames"])
        width, height = results.get("image_size_px", image_size_px or (0, 0))
        folder, verdict = results["recording"] if own else "", Verdict(tuple(Reason(**r) for r in results["reasons"] if own))
    except (ValueError, KeyError, TypeError) as error:
        what = f"{path}: not the results of {paths.shown(rig)} ({error!r})"
        raise ValueError(f"{what}; calibrate again, or move that file away.") from None
    if image_size_px and (width, height) != tuple(image_size_px):
        what = "the recording has {} x {} px".format(*image_size_px)
        what = f"its cameras are for images of {width} x {height} px, {what}"
        raise ValueError(f"{paths.shown(rig)}: {what}; calibrate with images of this size.")
    return folder, verdict, offsets, varied


def _common_motion(moved: StereoRig, found: Assessment, offsets: LandmarkOffsets | None) -> Verdict:
    """Doubts a common motion of both cameras if it explains the landmarks worse than cameras calibrated from them."""
    if found.calibration is None or len(found.data.complete) < _FEWEST:
        return Verdict()

    def error_px(rig: StereoRig, own: LandmarkOffsets | None) -> float:
        data = with_offsets(found.data, own)
        return np.nanmedian(np.linalg.norm(np.stack([data.u_left, data.u_right]) - rig.project(data.x_mm), axis=2))

    now, anew = error_px(moved, offsets), error_px(found.calibration.pair, found.calibration.offsets)
    level = LEVELS[np.searchsorted(LIMITS["residuals"], now / max(anew, _EXACT_PX))]
    text = f"The moved cameras miss the landmarks by {now:.1f} px (median), cameras calibrated from them by {anew:.1f} px."
    cure = "Did only one camera move, did zoom or focus change, is --rig of another microscope? Calibrate again."
    return Verdict(() if level == LEVELS[0] else (Reason("no_common_motion", level, text, cure),))


def _parsed(name: str, function: object, argv: list[str]) -> tuple[argparse.Namespace, Recording, Path]:
    parser = argparse.ArgumentParser(prog=f"python3 -m lib {name}", description=function.__doc__.split(": ", 1)[1])
    add = parser.add_argument
    add("recording", type=Path, help="folder of a recording")
    add("--out", type=Path, help="folder of the results (default: runs/NAME of the recording)")
    add("--landmarks", choices=("detected", "annotations"), default="detected", help="where they come from")
    add("--weights", help="weights file of the detector (default: the shipped ones)")
    add("--frames", metavar="A:B", help="use frames A to B - 1 (default: all); --frames=-10: uses the last ten")
    add("--model", help="camera model: zero_skew, near_affine (a finite distance), affine, ... (default: chosen by the data)")
    if name != "detect":  # only these refuse results
        add("--force", action="store_true", help="write results whatever the verdict")
    if name == "reconstruct":
        add("--frame", type=int, help="number of the frame, from 0 (default: the first)")
        add("--setting", choices=("quality", "fast"), default="quality")
    if name in ("reconstruct", "register"):
        add("--rig", type=Path, required=name == "register", help="rig.json of an earlier calibration")
    a = parser.parse_args(argv)
    if a.weights and a.landmarks == "annotations":
        parser.error("--weights: with --landmarks annotations no detector is used; leave one of the two out.")
    if name == "reconstruct" and a.rig and (a.model or a.frames):
        parser.error("--model, --frames: with --rig no camera is calibrated; leave them out, or --rig.")
    a.options = {"model": a.model} if a.model else {}
    Model.parse(a.model or "zero_skew", 2)  # refuses an unknown model
    recording = Recording.open(a.recording)
    a.image_size_px = recording.image_size_px
    some, a.frames = a.frames, recording.frames_of(a.frames or ":")
    if name == "reconstruct":
        a.frame = a.frames[0] if a.frame is None else a.frame + len(recording) * (a.frame < 0)
        if a.frame not in a.frames:
            parser.error(f"--frame: choose one of frames {a.frames[0]} to {a.frames[-1]}.")
    a.detector = None if a.landmarks == "annotations" else SharedDetector(Detector.load(a.weights))
    part = f"-{a.frames.start}-{a.frames.stop}" if some else ""  # each part has its own results
    out = a.out or paths.results_folder(a.recording.resolve().name + part, a.recording)
    out.mkdir(parents=True, exist_ok=True)
    a.earlier = {path: path.lstat().st_mtime_ns for path in out.iterdir()}
    return a, recording, out


def _labelled(recording: Recording) -> Correspondences:
    if recording.annotations is None:
        raise ValueError(f"{recording.folder}: it has no annotations.json; label frames, or use --landmarks detected.")
    return of_recording(recording, recording.annotations.u_left, recording.annotations.u_right)


def _data(a: argparse.Namespace, recording: Recording, frames: np.ndarray | None = None) -> Correspondences:
    frames = np.array(a.frames) if frames is None else frames
    if a.landmarks == "annotations":
        return _labelled(recording).of_frames(frames)
    if recording.skeleton != LANDMARKS:
        what = f"the detector knows {list(LANDMARKS)}, the recording has {list(recording.skeleton)}"
        raise ValueError(f"{recording.folder}: {what}. Label frames and give --landmarks annotations.")
    return detect(recording, a.detector, frames=frames)


def _calibrated(
    a: argparse.Namespace, recording: Recording, out: Path
) -> tuple[Calibration | StereoRig | None, LandmarkOffsets | None, Verdict, Correspondences]:
    """The calibration (None if refused) or the rig of --rig; its landmarks' offsets; the verdict; the landmarks."""
    if given := getattr(a, "rig", None):
        # A wrong rig is refused before the detector takes its time.  Only the frame's landmarks are needed, for the mask.
        rig, (folder, verdict, offsets, _) = StereoRig.load(given), _results_of_rig(given, a.frame, recording.image_size_px)
        data = _data(a, recording, np.array([a.frame]))
        if folder != str(recording.folder.resolve()):
            text = f"{given}: nothing here shows that this rig fits this frame."
            same = [f"--{name}={value}" for name in ("weights", "landmarks") if (value := getattr(a, name, None))]
            register = shlex.join(["python3", "-m", "lib", "register", str(a.recording), "--rig", str(given), *same])
            cure = f"Run: {register}; then give the moved_rig.json that it writes as --rig."
            verdict = Verdict((Reason("rig_given", LEVELS[1], text, cure),))
    else:
        data = _data(a, recording)
        found = _assessed(a, recording, data)
        rig, verdict, offsets = found.calibration, found.verdict, found.calibration and found.calibration.offsets
    return None if _refused(a, out, verdict, rig is not None) else rig, offsets, verdict, data


def _refused(a: argparse.Namespace, out: Path, verdict: Verdict, found: bool = True) -> bool:
    """True if no cameras were `found` or the verdict forbids results; then only prints it and writes verdict.json."""
    if found and (a.force or not verdict.is_red):
        (out / "verdict.json").unlink(missing_ok=True)  # from an earlier run that was refused
        return False
    files.write_json(out / "verdict.json", verdict.to_json())
    force = "; --force writes the results whatever the verdict" if found else ""
    earlier = a.earlier.keys() - {out / "verdict.json", out / paths.RECORDING_NOTE}
    earlier = f" Results of an earlier run are in {paths.shown(out)}." if earlier else ""
    print(f"{verdict}\nNothing else was written{force}.{earlier}")
    return True


def _done(a: argparse.Namespace, out: Path, name: str, numbers: dict, verdict: Verdict) -> int:
    numbers |= {"recording": str(a.recording.resolve()), "frames": [a.frames.start, a.frames.stop]}
    numbers |= {"image_size_px": list(a.image_size_px)} | verdict.to_json()
    files.write_json(out / f"{name}.json", numbers)
    written = sorted(path.name for path in out.iterdir() if path.lstat().st_mtime_ns != a.earlier.get(path))
    print(f"Wrote {paths.shown(out)}: {', '.join(written)}\n{verdict}")
    return 0


def _write_landmarks(path: Path, recording: Recording, data: Correspondences) -> None:
    wide = [f"{side}_{what}" for side in ("left", "right") for what in ("x_px", "y_px", "confidence", "sd_x_px", "sd_y_px")]
    lines = [",".join(["frame", "landmark", "time_s", "x_mm", "y_mm", "z_mm", *wide])]
    sd = np.sqrt(np.diagonal(data.covariance_px2, axis1=2, axis2=3))
    sides = np.dstack([np.stack([data.u_left, data.u_right], axis=1), data.confidence, sd]).reshape(-1, 10)
    for frame, landmark, *numbers in zip(data.frame, data.landmark, data.time_s, *data.x_mm.T, *sides.T, strict=True):
        cells = ["" if np.isnan(value) else f"{value:.6f}" for value in numbers]
        lines.append(",".join([str(frame), recording.skeleton[landmark], *cells]))
    files.write_text(path, "\n".join(lines) + "\n")


def _write_rig(out: Path, rig: StereoRig, recording: Recording, prefix: str = "") -> None:
    rig.save(out / f"{prefix}rig.json")
    for side, camera in (("left", rig.left), ("right", rig.right)):
        write_opencv(camera, out / f"{prefix}{side}.yml", recording.image_size_px)
        (info := out / f"{prefix}{side}_camera_info.yaml").unlink(missing_ok=True)  # from an earlier run
        if not getattr(camera, "radial_per_px2", 0.0):
            write_ros(camera, info, recording.image_size_px, name=side)


def _write_rectified(out: Path, found: Reconstruction, left: np.ndarray, right: np.ndarray) -> None:
    """Write the rectified pair, and the matrices from it to the images.  Stereo networks expect disparities from 0 on."""
    maps = rectify(found.rig, left.shape[:2], right.shape[:2])
    sides = (maps.left_from_canvas, found.matches.u_left), (maps.right_from_canvas, found.matches.u_right)
    x_left, x_right = (np.linalg.solve(matrix[:, :2], (u - matrix[:, 2]).T)[0] for matrix, u in sides)
    low, high = np.percentile(x_left - x_right, (0.5, 99.5))
    margin = 2 + 0.1 * (high - low)
    shift = int(np.ceil(margin - low))  # a whole number, so that it does not blur
    right_from_canvas = maps.right_from_canvas + maps.right_from_canvas[:, :1] * (0, 0, shift)
    for side, image, matrix in (("left", left, maps.left_from_canvas), ("right", right, right_from_canvas)):
        warped = cv2.warpAffine(image, matrix, maps.size_px, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        files.write_bytes(out / f"rectified_{side}.png", encoded(warped, ".png"))
    reference_depth_mm = maps.reference_depth_mm + shift / maps.displacement_px_per_mm  # there the disparity is 0
    numbers = {"left_from_canvas": maps.left_from_canvas.tolist(), "right_from_canvas": right_from_canvas.tolist()}
    numbers |= {"displacement_px_per_mm": maps.displacement_px_per_mm, "reference_depth_mm": reference_depth_mm}
    numbers |= {"disparity_range_px": [0, int(np.ceil(high + margin)) + shift]}
    files.write_json(out / "rectification.json", numbers)
