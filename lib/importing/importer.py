"""Turns the files of other programs into a recording.  All of them are checked first, and it appears whole or not at all."""

import re
import warnings
from contextlib import suppress
from dataclasses import replace
from decimal import Decimal
from functools import partial
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader
from scipy.spatial.transform import Rotation, Slerp

from lib import files
from lib.calibration import NoConsensusError, TimeOffset, Tool, calibrate_as_shown, pivot_calibration, tool_offsets
from lib.calibration.timing import clock_error, estimate_time_offset
from lib.correspondences import LANDMARKS, DataError, NoDetectionError, of_recording
from lib.geometry import RigidTransform
from lib.importing.labels import read_labels
from lib.importing.logs import read_robot, since
from lib.importing.mapping import Mapping, read_mapping
from lib.importing.video import StereoSource, open_stereo
from lib.landmarks import SharedDetector, detect
from lib.recordings import Annotations, Kinematics, Recording, RecordingWriter

_SURE_S = 0.02  # largest standard deviation of a clock's offset that is found among all
_CLOCK_FRAMES = 60  # number of frames in which the landmarks are detected for the clock offset, if there are no labels
_EPOCH_S = 1_000_000  # larger times count from a date; as floats they would not resolve 100 ns, so a zero is subtracted


def import_recording(source: str | Path, mapping: str | Path, out: str | Path, *, overwrite: bool = False) -> dict:
    """Write the recording `out` from the files that a mapping describes.  The folder `source` is never changed.

    The same input gives the same bytes.  An error names the file and the cure; then nothing is written.

    Returns the content of import.json: what was done ("did", in sentences), "clock", "tool", "sources" with SHA-256, ...
    """
    folder, out = Path(source), Path(out)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; SOURCE is the folder that holds the files of the mapping.")
    if out.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"{out}: lies in the source, which an import does not change; choose another folder.")
    if any(Path(path).resolve().is_relative_to(out.resolve()) for path in (folder, mapping)):
        raise ValueError(f"{out}: holds your files, and --overwrite replaces all of it; choose another --out.")
    spec = read_mapping(mapping)
    stereo = open_stereo(folder, spec.video)
    robot_time, *reported = read_robot(folder, spec, notes := list(stereo.notes))
    # Subtract the first whole second of times that count from a date, and of times of day unless both tables have such.
    of_day = [table is not None and table.time_unit == "hms" for table in (spec.video.table, spec.robot)]
    starts = [stereo.time[0], robot_time[0]]
    dated = [abs(t) > _EPOCH_S or (day and not all(of_day)) for t, day in zip(starts, of_day, strict=True)]
    zeros = stereo_zero, robot_zero = [Decimal(int(t) if date else 0) for t, date in zip(starts, dated, strict=True)]
    one_dated = bool(stereo_zero) != bool(robot_zero)  # then the search assumes that log and video began together
    estimated = spec.robot.offset_s == "estimate"
    given = Decimal("0" if estimated else str(spec.robot.offset_s))
    offset_s = 0.0 if estimated and one_dated else float(stereo_zero + given - robot_zero)
    time_s, robot_s = since(stereo.time, stereo_zero), since(robot_time, robot_zero)
    size = next(stereo.pairs())[0].shape[1::-1]  # width and height
    labels = read_labels(folder, spec.labels, stereo, spec.landmarks, size) if spec.labels else None
    least, most = robot_s[0] - time_s[-1], robot_s[-1] - time_s[0]  # the offsets with which log and video overlap
    search_s = spec.robot.search_s if estimated else 0.0
    if not least - search_s <= offset_s <= most + search_s:
        spans = [f"{time[0]:.3f} to {time[-1]:.3f} s" for time in (robot_time, stereo.time)]
        what = "its times ({}) and those of the frames ({}) do not overlap".format(*spans)
        low, high = sorted(robot_time[end] - stereo.time[end] for end in (0, -1))
        cure = f"a number from {low:.3f} to {high:.3f}, so that they overlap (t_robot = t_video + offset_s)"
        cure += ', or to "estimate" if log and video began together' if one_dated and not estimated else ""
        cure += f", or widen robot.search_s to {max(least - offset_s, offset_s - most) + 1:.0f}" if estimated else ""
        half_hours = int(float(high) // 1800)  # the largest offset in half hours that makes them overlap
        if (all(zeros) or all(of_day)) and low <= 1800 * half_hours and 0 < abs(half_hours) <= 28:
            hours = f"{half_hours / 2:+g} hour{'s' * (abs(half_hours) != 2)}"
            cure += f". Is a time zone of {hours} between them? Then offset_s = {1800 * half_hours}"
        cure = f"If the log is of the same run, set robot.offset_s (now {spec.robot.offset_s!r}) in {mapping} to {cure}"
        raise ValueError(f"{folder / spec.robot.file}: {what}. {cure}.")
    if estimated:  # the search starts where they overlap; times are rounded to 1e-7 s
        offset_s = float(np.clip(offset_s, least + 1e-6, most - 1e-6))
    frames_s = time_s + offset_s
    if labels is not None:  # with a rolling shutter: the mean time at which the rows of a frame's labels were read
        y = np.hstack([labels.u_left[..., 1], labels.u_right[..., 1]])
        mean = np.nansum(y - (size[1] - 1) / 2, axis=1) / np.maximum(np.isfinite(y).sum(axis=1), 1)
        frames_s += spec.readout_s * mean / (size[1] - 1)
    x_mm, tool = _landmarks(spec, reported, robot_s, frames_s, labels, float(robot_zero))
    usual_fps = round(1 / float(np.median(np.diff(time_s))) if len(time_s) > 1 else 25.0, 6)
    fps = usual_fps if spec.video.fps is None else spec.video.fps / spec.video.every
    writer = RecordingWriter(
        out, name=spec.name, description=spec.description, fps=fps, image_size_px=size, readout_s=spec.readout_s,
        offset_s=offset_s, robot_accuracy_mm=spec.robot_accuracy_mm, skeleton=spec.landmarks, overwrite=overwrite,
        suffix=f".{spec.video.format}", jpeg_quality=spec.video.jpeg_quality, own_times=spec.video.times != "fps",
    )  # fmt: skip
    try:
        with writer:
            for (left, right), t in zip(stereo.pairs(), time_s, strict=True):
                writer.add(left, right, t)
            writer.kinematics(robot_s, x_mm)
            if labels is not None:
                writer.annotations(labels.u_left, labels.u_right, labels.visibility_left, labels.visibility_right)
            with warnings.catch_warnings(action="ignore"):  # the offset may change; what is doubted then is said at the end
                draft = writer.draft()
            zero_s = float(robot_zero - stereo_zero)
            clock, found = _clock(draft, spec.robot.search_s, notes, zero_s) if estimated else None, None
            if isinstance(clock, TimeOffset):
                draft = writer.draft(clock.offset_s)
                found = {"offset_s": round(clock.offset_s, 9), "sd_s": float(f"{clock.sd_s:.3g}")}
            elif clock:
                what = f"the offset of the clocks was not found; offset_s = {offset_s:g} is a guess"
                warnings.warn(f"{out}: {what}. State robot.offset_s in {mapping}, or correct it there.", stacklevel=2)
            did = [*_did(spec, stereo, draft, clock, zeros), *notes]
            report = {"format": "microstereo.import", "did": did, "clock": found}
            report |= {"tool": tool, "mapping": spec.model_dump(mode="json"), "sources": _sources(folder, spec, stereo)}
            files.write_json(writer.folder / "import.json", report)
    except ValueError as error:  # names the temporary folder of the unfinished recording, which no longer exists
        text = str(error).replace(str(writer.folder / "recording.toml"), str(mapping))
        text = text.replace(f"{writer.folder / 'kinematics.csv'}: ", f"{folder / spec.robot.file}, read with {mapping}: ")
        raise ValueError(text.replace(str(writer.folder), str(out))) from None
    return report


def _clock(draft: Recording, search_s: float, notes: list[str], zero_s: float = 0.0) -> TimeOffset | str:
    """Estimate the clock offset from labels, or from detections if there are none.

    If no offset within `search_s` explains them, all offsets with which log and video overlap are searched.  One found so
    must be certain, and `notes` gets a sentence.  Returns the reason as a string if the detector does not know the tool,
    and log and video do overlap.  Errors state offsets between the times in the files, which are larger than offsets of the
    draft by `zero_s`.
    """
    if (labels := draft.annotations) is not None:
        known = {"u_left": labels.u_left, "u_right": labels.u_right}
    elif draft.skeleton != LANDMARKS:
        return f"the detector knows only {', '.join(LANDMARKS)}, and there are no labels"
    else:
        some = np.unique(np.linspace(0, len(draft) - 1, min(len(draft), _CLOCK_FRAMES)).astype(int))
        seen = detect(replace(draft, readout_s=0.0), SharedDetector(), frames=some)  # readout 0 keeps the pixels
        known = {name: seen.grid(name) for name in ("u_left", "u_right", "covariance_px2", "confidence")} | {"frames": some}
    paired = partial(of_recording, **known)
    least, most = (draft.kinematics.time_s[end] - draft.frames.time_s[-1 - end] for end in (0, -1))
    failures: list[ValueError] = []
    for start_s, reach_s in ((draft.offset_s, search_s), ((least + most) / 2, (most - least) / 2)):
        try:
            found = estimate_time_offset(paired(draft), draft.kinematics, start_s=start_s, search_s=reach_s)
        except ValueError as error:
            failures.append(error)
            continue
        if not failures:
            break
        silent = np.isnan(paired(replace(draft, offset_s=found.offset_s)).x_mm).any(axis=1)
        if found.sd_s < _SURE_S and silent.mean() < 0.5:  # the motion of another run may fit a few labels by chance
            what = "all with which log and video overlap were tried"
            notes.append(f"The clock offset lies beyond search_s = {search_s:g}: {what}.")
            break
    else:
        error = failures[0]
        said = {doubt.name: f"{doubt.text} {doubt.cure}" for doubt in draft.doubts if doubt.is_of_time}
        wrong = said.pop("little_overlap", None)  # at the offset where the search began, so that it had to find another
        if labels is None and isinstance(error, NoConsensusError | NoDetectionError) and not wrong:
            return str(error).removesuffix(".")
        low, high = (zero_s + draft.offset_s + end_s for end_s in (-search_s, search_s))
        what = re.sub(r" \(`[^`]*`\)|; widen search_s", "", str(error).split(": ", 1)[-1])  # there is no recording to check
        what = what.replace("search_s", "robot.search_s")
        tried = f"No offset from {zero_s + least:.3f} to {zero_s + most:.3f} s fits"
        cure = " ".join([f"{tried}. Give a number: t_robot = t_video + offset_s.", *said.values()])
        raise ValueError(f"robot.offset_s, searched from {low:.3f} to {high:.3f} s: {what} {cure}") from None
    with suppress(DataError, np.linalg.LinAlgError):  # a full calibration needs more data
        data = paired(replace(draft, offset_s=found.offset_s))
        calibration = calibrate_as_shown(data, image_size_px=draft.image_size_px)
        step_s, sd_s = clock_error(calibration, data, draft.kinematics, found.offset_s)  # with free landmark offsets
        found = replace(found, offset_s=found.offset_s + step_s, sd_s=sd_s) if np.isfinite(sd_s) else found
    return found


def _landmarks(
    spec: Mapping, reported: list, robot_s: np.ndarray, frames_s: np.ndarray, labels: Annotations | None, zero_s: float
) -> tuple[np.ndarray, dict | None]:
    """The robot's landmarks (m, k, 3) mm; and if it reports poses, the tool's geometry for import.json."""
    x_mm, R, opening = reported  # as `read_robot` returns them
    if R is None:
        return x_mm, None
    known = np.isfinite(np.hstack([R, x_mm])).all(axis=(1, 2))
    if not known.any():
        names = ", ".join((*spec.robot.pose.position, *spec.robot.pose.rotation))
        what = f"no row has both a position and a rotation in {names} (a quaternion of zeros is unknown)"
        raise ValueError(f"robot.pose: {what}. Name other columns of {spec.robot.file}, or log the rotation.")
    poses = [RigidTransform(*pose) for pose in zip(R[known], x_mm[known, 0], strict=True)]
    opening = None if opening is None else opening[known]
    try:
        tool, sd = _tool(spec, poses, robot_s[known], opening, frames_s, labels, zero_s)
    except ValueError as error:  # `tool_offsets` and `pivot_calibration` name their own arguments
        key = f"tool.estimate, with offset_s = {spec.robot.offset_s}" if spec.tool.estimate else "tool.pivot_s"
        cure = "Check offset_s and the times, or give tool.hinge or tool.landmarks_mm."
        raise ValueError(re.sub(r"^(robot_from_tool|opening_rad|u):(.*)", rf"{key}:\2 {cure}", str(error))) from None
    x = np.full((len(known), len(spec.landmarks), 3), np.nan)
    x[known] = tool.positions_mm(poses, opening)
    kinds = {"offset_mm": tool.offset_mm, "sine_mm": tool.sine_mm, "versine_mm": tool.versine_mm, "sd_mm": sd}
    return x, {kind: dict(zip(spec.landmarks, values.round(6).tolist(), strict=True)) for kind, values in kinds.items()}


def _tool(
    spec: Mapping, poses: list[RigidTransform], robot_s: np.ndarray, opening: np.ndarray | None, frames_s: np.ndarray,
    labels: Annotations | None, zero_s: float,
) -> tuple[Tool, np.ndarray]:  # fmt: skip
    """The landmarks in the tool frame, and the standard deviations (k, 3) mm of their offsets, 0 where not estimated."""
    names, tool = spec.landmarks, spec.tool
    turning = [tool.turning.get(name, 0) if opening is not None else 0 for name in names]
    if tool.estimate:
        if labels is None or spec.robot.offset_s == "estimate":
            raise ValueError("tool.estimate: needs labels, and robot.offset_s as a number; or give the tool's landmarks.")
        reported_mm = Kinematics(robot_s, np.array([[pose.t] for pose in poses])).at(frames_s)[:, 0]
        inside = np.isfinite(reported_mm).all(axis=1)  # NaN in a gap of the log
        at, u = frames_s[inside], [side[inside] for side in (labels.u_left, labels.u_right)]
        turns = Slerp(robot_s, Rotation.from_matrix([pose.R for pose in poses]))(at).as_matrix()
        jaws = {} if opening is None else {"opening_rad": np.interp(at, robot_s, opening), "turning": turning}
        found = tool_offsets([RigidTransform(R, t) for R, t in zip(turns, reported_mm[inside], strict=True)], u, **jaws)
        return found, np.sqrt(np.diagonal(found.covariance_mm2, axis1=1, axis2=2))
    offset = np.array([tool.landmarks_mm.get(name, (np.nan, np.nan, np.nan)) for name in names])
    sd = np.zeros_like(offset)
    for name, span_s in tool.pivot_s.items():
        k, (low, high) = names.index(name), np.subtract(span_s, zero_s)
        pivot = pivot_calibration([pose for pose, t in zip(poses, robot_s, strict=True) if low <= t <= high])
        offset[k], sd[k] = pivot.offset_mm, np.sqrt(np.diagonal(pivot.covariance_mm2)[:3])
    hinged = tool.hinge is not None and any(turning)
    if lacks := [n for n, x, t in zip(names, offset, turning, strict=True) if np.isnan(x).any() and not (hinged and t)]:
        cure = "give tool.landmarks_mm, tool.pivot_s, tool.hinge with robot.pose.gripper, or tool.estimate = true"
        raise ValueError(f"robot.pose: the position of {', '.join(lacks)} in the tool frame is not given; {cure}.")
    if hinged:
        return Tool.hinged(np.nan_to_num(offset), turning, tool.hinge.point_mm, tool.hinge.axis, tool.hinge.jaw_mm), sd
    return Tool(offset, np.zeros_like(offset), np.zeros_like(offset)), sd


def _did(
    spec: Mapping, stereo: StereoSource, draft: Recording, clock: TimeOffset | str | None, zeros: list[Decimal]
) -> list[str]:
    """Render did.txt: the steps of the import, one sentence or more in each line."""
    time_s, pair, labels = draft.frames.time_s, draft.frames[0], draft.annotations
    step = np.diff(time_s) if len(time_s) > 1 else np.array([0.0])
    seen = () if labels is None else (labels.visibility_left, labels.visibility_right)
    return Environment(loader=FileSystemLoader(Path(__file__).parent), trim_blocks=True).get_template("did.txt").render(
        spec=spec, stereo=stereo, draft=draft, clock=clock, span_s=np.ptp(time_s), step=step, usual_step=np.median(step),
        is_grey=all((image == image[..., :1]).all() for image in (pair.left, pair.right)),
        gaps=np.isnan(draft.kinematics.x_mm[..., 0]).any(axis=1).sum(),
        zeros=[(what, zero) for what, zero in zip(("video", "robot"), zeros, strict=True) if zero],
        in_mapping_s=round(Decimal(draft.offset_s), 7) + zeros[1] - zeros[0], both_dated=all(zeros),
        silent=np.isnan(draft.landmarks_mm()).all(axis=(1, 2)).sum(),
        labelled=tuple((visibility > 0).any(axis=1).sum() for visibility in seen),
    ).rstrip().split("\n")  # fmt: skip


def _sources(folder: Path, spec: Mapping, stereo: StereoSource) -> list[dict]:
    """The sources, each with its SHA-256; for a folder or a pattern, one of all its files in order."""
    videos = (spec.video.left, spec.video.right) if spec.video.layout == "two" else (spec.video.file,)
    names = {name: list(reel.files) for reel, name in zip(stereo.reels, videos, strict=True)}
    others = [spec.robot.file, spec.video.table.file if spec.video.table else ""]
    others += [spec.labels.file, spec.labels.left, spec.labels.right] if spec.labels else []
    for name in filter(None, others):
        path = folder / name
        names[name] = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    return [{"file": name, "files": len(paths), "sha256": files.digest(*paths, length=64)} for name, paths in names.items()]
