"""Hypotheses about time: clocks, frame rates, the order of the frames, and the shutter."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from lib.calibration.timing import shift_misfits
from lib.correspondences import Correspondences
from lib.recordings import Kinematics
from lib.trust.fitting import FITS, HOPELESS, SIDES, Case, Hypothesis, Problem, Robust, by_steps

#: Clock rates that are tried: seconds of the robot's clock per second of the video's stated time; -1 is time backwards.
_RATES = (-1.0, 0.5, 24 / 30, 25 / 30, 24 / 25, 25 / 24, 30 / 25, 30 / 24, 2.0)
_ROWS, _MOST_TRIALS = 400, 1200  # of the coarse search: most rows, and most trial shifts on each side of 0
_LONGEST_S = 60.0  # largest half width of the wide search, made if the cameras do not fit or the best shift is at the edge
#: Gain in log likelihood by another clock or order from which the order of names as text is tried, too; and that of a clock
#: that jumps over one that does not.
_WORTH = 20.0
_LEAST_DRIFT = 5e-6  # smallest difference of a rate from 1 that is named; in half an hour it adds up to 9 ms
#: A rate that differs from 1 by more is only named if the cameras then fit.  Rates outside these limits are never named.
_FAR_OFF, _LIKELY = 0.01, (0.4, 2.5)
_STAMPS_S, _STAMPS = (0.03, 0.06, 0.12), 31  # largest errors of the times of single frames, and number of trials up to each
_ASTRAY = 10.0  # largest residual of frames of other instants, over the scale; at no instant do wrong detections fit so well
_OUTSIDE = 0.25  # least share of frames outside the log if a clock is wrong; a log that only begins late misses fewer
#: The log likelihood by which a filter must explain the rows better than a late clock: on an even path they hardly differ.
_SURELY_FILTERED, _UNFILTERED = 10.0, "Log the positions as they are measured, without a filter."
#: The cure if one camera's images belong to other instants.
PAIR_AGAIN = "Look for images that one camera lost, and pair left and right images of one instant."


def _clock(case: Case) -> Iterator[Hypothesis]:
    """A clock offset: the images show the robot's positions of another instant, in both cameras or in one."""
    trial, misfit = _scan(case, min(1.0, 0.4 * case.paths.span_s))
    at_edge = np.abs(trial[misfit.sum(axis=1).argmin()]) > 0.9 * trial[-1]
    if at_edge or case.misfit(case.null) >= FITS:
        farther = _scan(case, min(case.paths.span_s, _LONGEST_S))
        if at_edge or farther[1].sum(axis=1).min() < misfit.sum(axis=1).min():
            trial, misfit = farther
    now = len(trial) // 2
    for name, views, score in (
        ("clock", (0, 1), misfit.sum(axis=1)), ("camera_clock", (0,), misfit[:, 0] + misfit[now, 1]),
        ("camera_clock", (1,), misfit[:, 1] + misfit[now, 0]),
    ):  # fmt: skip
        if (fitted := _refined(case, trial[[np.argmin(score)]], np.ones((1, len(case.problem))), views)) is None:
            continue
        fit, problem, (value,), (sd,) = fitted
        size = f"{1e3 * value:z.1f} +- {1e3 * sd:.1f} ms"
        if name == "clock":
            text = f"The residuals lie along the image of the tool's velocity: the clocks differ by {size}."
            cure = f"Add {value:.4f} to offset_s in recording.toml; estimate_time_offset checks it."
        else:
            size, when = size.lstrip("-"), "before" if value < 0 else "after"
            text = f"The {SIDES[views[0]]} camera alone shows the tool {size} {when} the frame's time."
            cure = f"Trigger both cameras together, or pair each right image with the left one of its instant ({size})."
        yield case.found(name, fit, 1, (1e3 * value, 1e3 * sd, "ms"), text, cure, on=problem, images=views)


def _refined(
    case: Case, value: np.ndarray, columns: np.ndarray, views: tuple[int, ...] = (0, 1)
) -> tuple[Robust, Problem, np.ndarray, np.ndarray] | None:
    """Refine the clock's shift, value (k,) @ columns (k, n) s, by Gauss-Newton: the fit, its rows, the values, their sds."""
    start = None
    for _ in range(6):
        later = value @ columns
        velocity = case.velocity(later)
        problem = case.problem.moved_to(np.where(np.isfinite(velocity), case.moved(later), np.nan), views)
        if problem.used.all(axis=1).sum() < 6:
            return None
        steps = velocity[:, None, :, None] * np.isin((0, 1), views)[:, None, None] * columns.T[:, None, None]
        fit = problem.fit(by_steps(steps), start=start)
        start, sd = fit.start, np.sqrt(np.diag(fit.covariance))
        if (np.abs(fit.theta) < 0.1 * sd).all():
            break
        value = value + np.clip(fit.theta, -0.1, 0.1)
    return fit, problem, value, sd


def _scan(
    case: Case, half_s: float, rate: float = 1.0, moves: np.ndarray | bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Trial shifts (t,) s of the clock, of all rows or those that `moves`, and the misfit (t, 2) of each camera alone."""
    problem = case.problem
    trial = np.linspace(-half_s, half_s, 2 * int(np.clip(half_s / 0.02, 5, np.clip(half_s / 0.05, 60, _MOST_TRIALS))) + 1)
    chosen = np.unique(np.linspace(0, len(problem) - 1, _ROWS).astype(int))
    later = (rate - 1.0) * (problem.time - np.median(problem.time))
    y = np.where(problem.used[:, :, None], problem.y, np.nan)[chosen].reshape(-1, 4)
    return trial, shift_misfits(case.moved(trial[:, None] * moves + later)[:, chosen], y)


def _clock_rate(case: Case) -> Iterator[Hypothesis]:
    """A wrong frame rate, or frames in reverse order.  Rates far from 1 are tried only if the residuals are large."""
    rate, shift = 1.0, 0.0
    if case.misfit(case.null) >= FITS:
        # Clocks of different rates that started together differ by (rate - 1) / 2 of the span in its middle.
        scans = {rate: _scan(case, (0.2 + abs(abs(rate) - 1) / 2) * case.paths.span_s, rate) for rate in (1.0, *_RATES)}
        rate = min(scans, key=lambda r: scans[r][1].sum(axis=1).min())
        trial, misfit = scans[rate]
        shift = float(trial[misfit.sum(axis=1).argmin()])
    time = case.problem.time - np.median(case.problem.time)
    if (fitted := _refined(case, np.array([shift, rate - 1.0]), np.stack([np.ones(len(time)), time]))) is None:
        return
    fit, problem, (shift, value), (shift_sd, sd) = fitted
    if not _LIKELY[0] < abs(1 + value) < _LIKELY[1] or (abs(value) > _FAR_OFF and case.misfit(fit) >= FITS):
        return  # by chance, part of a path passes near some frames; or time stands still, and all frames show one instant
    if rate < 0:
        text, cure = "The images fit the robot's path run backwards.", "Sort the frames by time."
        yield case.found("frame_order", fit, 4, (0.0, 0.0, ""), text, cure, on=problem)
    elif abs(value) >= max(5.0 * sd, _LEAST_DRIFT):
        text = f"In one second of the video's time {1 + value:.6f} +- {sd:.1g} s of the robot's time pass."
        what, factor = ("time_s in frames.csv", 1 + value) if case.own_times else ("fps in recording.toml", 1 / (1 + value))
        cure = f"Multiply {what} by {factor:.6f}, or write the frames' true times to frames.csv."
        shift -= value * np.median(case.problem.time)
        if abs(shift) > 5.0 * np.hypot(shift_sd, sd * np.median(case.problem.time)):
            cure += f" Add {shift:.4f} to offset_s as well."
        yield case.found("clock_rate", fit, 4, (1 + value, sd, "times"), text, cure, on=problem)


def _clock_jump(case: Case) -> Iterator[Hypothesis]:
    """A clock that jumps, or frames that were lost: from one frame on, the images show the tool at other instants."""
    problem = case.problem
    found = [_jump(case, cut) for cut in case.frames * np.arange(1, 4) // 4] if case.frames >= 8 else []
    if not (found := [one for one in found if one is not None]):
        return
    cut, fit, moved, value, sd = max(found, key=lambda one: one[1].total)
    steady = max((case.fits[name].total for name in ("clock", "clock_rate") if name in case.fits), default=-np.inf)
    if abs(value[1]) > 5.0 * sd[1] and fit.total > steady + _WORTH:
        (last, number), jump_s = problem.number[cut - 1 : cut + 1], float(value[1])
        about = f" (or {last + 1})" if number > last + 1 else ""  # only some frames of a long recording are fitted
        size = f"{1e3 * abs(jump_s):.1f} +- {1e3 * sd[1]:.1f} ms {'later' if jump_s > 0 else 'earlier'}"
        text = f"From frame {number}{about} on, the images show the tool {size}."
        cure = f"Look through the frames there for lost ones, or did a clock jump? Add {jump_s:.4f} s to the times "
        cure += f"from frame {number} on, in frames.csv (frame, time_s)."
        if jump_s < 0:  # such times would not increase
            since_s = case.at_s[problem.frame == cut].min() + value.sum()
            cure = f"Did the robot's clock jump back? Add {-jump_s:.4f} s to time_s in kinematics.csv "
            cure += f"from {since_s:.2f} s on."
        if abs(value[0]) > 5.0 * sd[0]:
            cure += f" Add {value[0]:.4f} to offset_s as well."
        yield case.found("frame_order", fit, 5, (1e3 * value[1], 1e3 * sd[1], "ms"), text, cure, on=moved)


def _jump(case: Case, cut: int) -> tuple[int, Robust, Problem, np.ndarray, np.ndarray] | None:
    """The frame of a jump, searched from `cut`; the fit, its rows; the shift before it and the jump (2,) s; their sds."""
    problem = case.problem
    late = problem.frame >= cut
    trial, misfit = _scan(case, min(2.0, 0.4 * case.paths.span_s), moves=late)
    known = np.isfinite(case.moved(trial[:, None] * late)).all(axis=2).sum(axis=1)
    misfit = np.where(known > 0.75 * known.max(), misfit.sum(axis=1), np.inf)  # others move frames out of the log
    value = np.array([0.0, trial[misfit.argmin()]])
    for _ in range(4):
        if (fitted := _refined(case, value, np.stack([np.ones(len(late)), late]))) is None:
            return None
        fit, moved, value, sd = fitted
        before, after = (_losses(case, fit, case.moved(shift)) for shift in np.cumsum(value))
        gain = np.bincount(problem.frame, before - after, case.frames)  # of each frame, if it comes after the jump
        last, cut = cut, int(np.cumsum(gain[::-1])[::-1][2:-2].argmax()) + 2
        late = problem.frame >= cut
        if cut == last:
            break
    return cut, fit, moved, value, sd


def _losses(case: Case, fit: Robust, x: np.ndarray) -> np.ndarray:
    """(n,) robust losses of a fit with the landmarks at positions x (n, 3); the mean where these are unknown."""
    r2 = (case.problem.missed(fit, np.repeat(x[:, None], 2, axis=1)) ** 2).sum(axis=2) / fit.shapes[0].scale ** 2
    losses = np.where(case.problem.seen, np.log1p(r2), 0.0).sum(axis=1)
    return np.where(np.isfinite(losses), losses, np.nanmean(losses))


def _frame_order(case: Case) -> Iterator[Hypothesis]:
    """Frames that are lost or in a wrong order: each frame may belong to another instant near its stated one."""
    step = np.median(np.diff(np.sort(np.nanmin(case.by_frame(case.problem.time), axis=1))))
    if case.frames < 8 or not step > 0:
        return
    trial, misfit = _scan(case, min(2.0, 0.4 * case.paths.span_s))  # after lost frames most fit a later instant
    shifts = step * (np.arange(-8, 9) + round(float(trial[misfit.sum(axis=1).argmin()]) / step))
    shifts = np.array(sorted({0.0, *shifts}, key=abs))  # where the path is unknown, all are equal
    steps_px = np.nan_to_num(np.abs(np.diff(case.by_frame(case.problem.y), axis=0))).max(axis=(1, 3), initial=0.0)
    for views in ((0, 1), (0,), (1,)):
        if len(views) == 1 and (steps_px[:, views[0]] < 0.1 * steps_px[:, 1 - views[0]]).mean() > 0.05:
            continue  # images of this camera repeat; `frozen_video` tests that
        fit, moved, own, raw = _chosen(case, shifts, views)
        astray = np.abs(shifts[own]) > step / 2
        others, first = 1e3 * shifts[own][astray], case.problem.number[astray.argmax()]
        if len(others) < 3:  # these may be spikes of the log
            continue
        rows = moved.used & astray[moved.frame][:, None] & np.isin((0, 1), views)
        if not rows.any() or np.median(np.linalg.norm(fit.residuals, axis=2)[rows]) > _ASTRAY * fit.shapes[0].scale:
            continue
        share, (low, high) = len(others) / case.frames, np.percentile(others, [5, 95])
        what = "frames" if len(views) == 2 else f"{SIDES[views[0]]} images"
        span = f"{low:+.0f} ms" if high - low < 1 else f"{low:+.0f} to {high:+.0f} ms"
        text = f"{100 * share:.0f} % of the {what} belong to other instants, mostly {span} from those stated"
        text += f", first in frame {first}."
        cure = "Sort the frames, look for lost ones, and write each one's true time to frames.csv."
        if len(views) == 1:
            cure = PAIR_AGAIN
        size = 100 * share, 0.0, "%"
        yield case.found("frame_order", fit, 1, size, text, cure, on=moved, raw=raw, images=views)


def _chosen(case: Case, shifts: np.ndarray, views: tuple[int, ...] = (0, 1)) -> tuple[Robust, Problem, np.ndarray, float]:
    """The fit with the best of `shifts` (s) for each frame, its rows, the choices (frames,), and the gain in likelihood.

    Of nearly equal ones the first is taken.
    """
    fit, moved, own = case.chosen(case.moved(shifts[:, None]), views)
    counts = np.bincount(own, minlength=len(shifts)) / case.frames
    penalty = -case.frames * float((counts * np.log(np.maximum(counts, 1e-9))).sum())  # entropy of the choices
    penalty += 0.5 * np.count_nonzero(counts) * np.log(case.frames)  # BIC of their frequencies
    return fit, moved, own, fit.total - case.null.total - penalty


def _time_stamps(case: Case) -> Iterator[Hypothesis]:
    """Times of the frames with errors of their own, so large that a trembling tool turns back meanwhile."""
    if case.frames < 8:
        return
    tried = [half_s * np.array(sorted(np.linspace(-1, 1, _STAMPS), key=abs)) for half_s in _STAMPS_S]
    shifts, (fit, moved, own, raw) = max(((shifts, _chosen(case, shifts)) for shifts in tried), key=lambda one: one[1][3])
    errors_s = shifts[own] - shifts[own].mean()
    if np.median(np.abs(errors_s)) > 0.5 * errors_s.std():  # else only some frames err, as by wrong detections
        sd_s, mean_s = float(errors_s.std()), float(shifts[own].mean())
        yield case.found("time_stamps", fit, 1, (1e3 * sd_s, 0.0, "ms"), *stamps_err(sd_s, mean_s), on=moved, raw=raw)


def stamps_err(sd_s: float, mean_s: float) -> tuple[str, str]:
    """Text and cure of times with independent errors about a mean."""
    text = f"The time stamps of frames or log have independent errors of {1e3 * sd_s:.2g} ms (RMS)"
    cure = "Record when the camera exposed each frame and when the robot measured each position; do not round. Did a program "
    cure += "change the frame rate? It repeats or drops images: export the camera's own."
    if abs(mean_s) > sd_s:
        text += f", and the clocks differ by about {1e3 * mean_s:.0f} ms"
        cure = f"Add {mean_s:.3f} to offset_s in recording.toml. {cure}"
    return f"{text}.", cure


def _sorted_as_text(case: Case) -> Iterator[Hypothesis]:
    """Images sorted by their names as text (0, 1, 10, 11, ..., 2), counted from 0 or from 1."""
    if all(fit.total < case.null.total + _WORTH for fit in case.fits.values()):  # no other clock or order explains anything
        return
    starts, number = np.nanmin(case.by_frame(case.problem.time), axis=1), case.problem.number
    for first, views in product((0, 1), ((0, 1), (0,), (1,))):
        order = np.array(sorted(range(number[-1] + 1), key=lambda i, first=first: str(i + first)))[number]
        later = (np.interp(order, number, starts) - starts)[case.problem.frame]
        moved = case.problem.moved_to(case.moved(later), views)
        if (order == number).all() or moved.used.all(axis=1).sum() < 6:
            continue
        fit = moved.fit(worth=case.null.total - HOPELESS)
        what = "images" if len(views) == 2 else f"{SIDES[views[0]]} images"
        text = f"The {what} are sorted by their names as text: {'1' if first else '0, 1'}, 10, 11, ... before 2."
        cure = "Sort them by number, or give the names leading zeros: 000, 001, 002, ..."
        share = 100.0 * float((order != number).mean())
        yield case.found("frame_order", fit, 1, (share, 0.0, "%"), text, cure, on=moved, images=views)


def _smoothed_log(case: Case) -> Iterator[Hypothesis]:
    """A log that a moving average has smoothed, which displaces each position by acceleration * window^2 / 24."""
    acceleration = case.paths.at(case.problem.landmark, case.at_s, 2)
    fit, known, value, sd = case.multiple_of(acceleration[:, None] / -24.0)
    if value > 3 * sd:
        text = f"The robot's log is smoothed over about {1e3 * np.sqrt(value):.0f} ms: this cuts corners and shrinks motion."
        size = 1e3 * np.sqrt(value), 500.0 * sd / np.sqrt(value), "ms"
        yield case.found("smoothed_log", fit, 1, size, text, _UNFILTERED, on=known)


def _filtered_log(case: Case) -> Iterator[Hypothesis]:
    """A log that a filter of first order delays: the true position is x + tau dx/dt, if tau is its time constant."""
    fit, known, value, sd = case.multiple_of(case.velocity()[:, None])
    late = max((case.fits[name].total for name in ("clock", "camera_clock") if name in case.fits), default=-np.inf)
    if value > 3 * sd and fit.total > late + _SURELY_FILTERED:
        text = f"The robot's log lags behind its motion, as by a filter of a time constant of {1e3 * value:.0f} ms."
        yield case.found("smoothed_log", fit, 1, (1e3 * value, 1e3 * sd, "ms"), text, _UNFILTERED, on=known)


def _backlash(case: Case) -> Iterator[Hypothesis]:
    """Backlash: a displacement that changes sign with the direction of motion, along each axis or along the shaft."""
    velocity = np.nan_to_num(np.where(case.problem.used.all(axis=1)[:, None], case.velocity(), 0.0))
    shaft = case.problem.axes[:, :, 0]
    along = (shaft * np.sign((shaft * velocity).sum(axis=1, keepdims=True)))[..., None]
    cure = "Measure positions on the tool's side of the gears, or approach each position from one side."
    for directions, where in ((np.sign(velocity)[:, None] * np.eye(3), "in x, y, z"), (along, "along the shaft")):
        fit = case.linear(by_steps(directions))
        size, sd = 2.0 * np.abs(fit.theta).max(), 2.0 * float(np.sqrt(np.diag(fit.covariance).max()))
        if size - 2.0 * sd > case.robot_mm:
            shifts = ", ".join(f"{2e3 * v:.0f}" for v in fit.theta)
            text = f"The robot has backlash: when it reverses, its true position shifts by {shifts} um {where}."
            yield case.found("backlash", fit, fit.theta.size, (1e3 * size, 1e3 * sd, "um"), text, cure)


def _readout(case: Case) -> Iterator[Hypothesis]:
    """A wrong read-out time of a rolling shutter; a negative one means that images are turned upside down."""
    if case.size is None:
        return
    row = np.clip(case.problem.y[:, :, 1:] / (case.size[1] - 1) - 0.5, -0.6, 0.6)
    for views in ((0, 1), (0,), (1,)):
        fit, known, value, sd = case.multiple_of(case.velocity()[:, None] * row * np.isin((0, 1), views)[:, None])
        readout_s = case.readout_s + value
        if readout_s < -3 * sd:
            who, them = ("Both images are", "both") if len(views) == 2 else (f"The {SIDES[views[0]]} image is", "it")
            text = f"{who} turned by 180 degrees: rows are read upwards, in {-1e3 * readout_s:.1f} +- {1e3 * sd:.1f} ms."
            keys = " and ".join(f"video.rotate_{SIDES[view]} = 180" for view in views)
            cure = f"Turn {them} by 180 degrees ({keys} in the mapping), with readout_s = {-readout_s:.4f}."
            yield case.found("turned_image", fit, 1, (1e3 * readout_s, 1e3 * sd, "ms"), text, cure, on=known, images=views)
        elif len(views) == 2:
            text = f"Residuals of a moving tool grow row by row: readout_s is off by {1e3 * value:.1f} +- {1e3 * sd:.1f} ms."
            cure = f"Set readout_s = {max(readout_s, 0.0):.4f} in recording.toml."
            yield case.found("readout", fit, 1, (1e3 * value, 1e3 * sd, "ms"), text, cure, on=known)


def log_elsewhere(data: Correspondences, kinematics: Kinematics | None, offset_s: float) -> list[Hypothesis]:
    """A clock that is so far off that the robot's log does not cover many of the frames."""
    time = np.unique(data.time_s[data.seen.any(axis=1)]) + offset_s
    if kinematics is None or not len(time) or not np.isfinite(time).all():
        return []
    first, last = kinematics.time_s[[0, -1]]
    outside = float(((time < first) | (time > last)).mean())
    if outside < _OUTSIDE:
        return []
    text = f"{100 * outside:.0f} % of the frames ({time[0]:.1f} to {time[-1]:.1f} s on the robot's clock) lie outside "
    text += f"its log ({first:.1f} to {last:.1f} s)."
    cure = "Check offset_s in recording.toml, and the times in frames.csv and kinematics.csv."
    return [Hypothesis("clock", text, cure, 0.0, np.inf, "ms", outside, 2.0 * len(data))]


#: Tests that need the tool's path over time (`Case.paths`).
TIME_TESTS = (
    _clock, _clock_rate, _clock_jump, _frame_order, _sorted_as_text, _time_stamps, _smoothed_log, _filtered_log, _backlash,
    _readout,
)  # fmt: skip
