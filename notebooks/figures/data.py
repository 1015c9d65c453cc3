"""Figures of notebook 01: rig, imaging effects, recordings, labels, realism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from lib.cameras import StereoRig
from lib.correspondences import LANDMARKS
from lib.recordings import Recording
from lib.simulator.eye import Scene
from lib.simulator.motion import Motion
from lib.simulator.rig import Microscope
from lib.simulator.window import Window
from lib.surface import open3d
from notebooks.figures.style import COLOURS, LANDMARK_COLOURS, figure, show_image
from notebooks.studies.realism import Profiles


def gallery(images: Mapping[str, np.ndarray], *, columns: int = 4, width_in: float = 12.0) -> Figure:
    """Images of one size in rows, with their titles."""
    rows = -(-len(images) // columns)
    height, width = next(iter(images.values())).shape[:2]
    page, axes = figure(
        rows, columns, width_in=width_in, height_in=rows * (width_in / columns * height / width + 0.3), squeeze=False
    )
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, (title, image) in zip(axes.flat, images.items(), strict=False):
        show_image(ax, image, title)
        ax.title.set_fontsize(9)
    return page


def contact_sheet(recording: Recording, indices: Sequence[int], *, columns: int = 4, shrink: int = 4) -> Figure:
    """Left images of a recording and their times, with the annotated landmarks if there are any."""
    rows = -(-len(indices) // columns)
    width, height = recording.image_size_px
    page, axes = figure(
        rows, columns, width_in=12, height_in=rows * (12 / columns * height / width + 0.25), squeeze=False
    )
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, k in zip(axes.flat, indices, strict=False):
        show_image(ax, recording.frames[k].left[::shrink, ::shrink], f"{recording.frames.time_s[k]:.1f} s")
        ax.title.set_fontsize(9)
        labels = recording.annotations.u_left[k] if recording.annotations else ()
        for colour, u in zip(LANDMARK_COLOURS.values(), labels, strict=False):
            ax.plot(*((u + 0.5) / shrink - 0.5), "o", color=colour, markersize=5, markeredgecolor="black")
    return page


def rig_page(scene: Scene, microscope: Microscope, rig: StereoRig) -> Figure:
    """A section through the eye with the two rays of one point, and the depth error against the angle between the axes.

    `rig` is in the microscope frame.
    """
    page, (section, error) = figure(1, 2, width_in=12, height_in=4.2, width_ratios=(1.7, 1))
    x = np.linspace(-9.6, 9.6, 400)
    z = scene.height(x, np.zeros_like(x))
    half = microscope.depth_of_field_mm / 2
    if np.isfinite(half):
        section.axhspan(microscope.focus_z_mm - half, microscope.focus_z_mm + half, color="#e8f1f8", zorder=0)
        section.text(-9.4, microscope.focus_z_mm - half + 0.08, "depth of field", va="top", fontsize=9, color="#446")
    section.fill_between(x, z, 4, color="#e9b08a")
    section.plot(x, z, color="#a4502c")
    point = np.array([1.0, 0.0, float(scene.height(np.array(1.0), np.array(0.0)))])
    for name, camera, side in (("left", rig.left, "right"), ("right", rig.right, "left")):
        d = camera.viewing_direction
        start = point - d * (point[2] + 4.5) / d[2]
        section.annotate("", point[[0, 2]], start[[0, 2]], arrowprops={"arrowstyle": "->", "color": COLOURS[name]})
        section.text(start[0], start[2] - 0.1, f" {name} ", color=COLOURS[name], ha=side)
    section.set(
        xlim=(-9.6, 9.6), ylim=(3.2, -5.2), xlabel="x (mm)", ylabel="z (mm), into the eye",
        title="Section through the microscope's frame, y = 0",
    )  # fmt: skip
    angle = np.deg2rad(np.linspace(2, 30, 80))
    um = 1e3 / (np.mean(microscope.pixels_per_mm) * np.sqrt(2) * np.sin(angle / 2))
    error.plot(np.rad2deg(angle), um, color=COLOURS["ours"])
    error.plot(
        np.rad2deg(rig.convergence_rad),
        np.interp(rig.convergence_rad, angle, um),
        "o",
        color=COLOURS["paper"],
    )
    error.set(
        xlabel="angle between the axes (degrees)", ylabel="depth error (um)", ylim=(0, None),
        title="Depth error of 1 px noise",
    )  # fmt: skip
    return page


def motion_page(motions: Mapping[str, Motion], *, samples: int = 1500) -> Figure:
    """Depth of the landmarks and opening of the jaws over time, and spectrum of the base's velocity; a row per motion."""
    page, axes = figure(len(motions), 3, width_in=12, height_in=2.7 * len(motions), squeeze=False)
    for row, (name, motion) in zip(axes, motions.items(), strict=True):
        time = np.linspace(0, motion.duration_s, samples)
        poses = [motion.pose(t) for t in time]
        x = np.array([motion.forceps.landmarks(pose) for pose in poses])
        for k, (landmark, colour) in enumerate(LANDMARK_COLOURS.items()):
            row[0].plot(time, x[:, k, 2], color=colour, label=landmark)
        row[0].invert_yaxis()
        row[0].set(xlabel="time (s)", ylabel="z (mm)", title=f"{name}: depth")
        row[0].legend(fontsize=8)
        row[1].plot(time, [pose.opening_mm for pose in poses], color=COLOURS["ours"])
        row[1].set(xlabel="time (s)", ylabel="opening (mm)", title="Jaws")
        step = 1 / 200
        dense = np.array([motion.pose(t).base_mm for t in np.arange(0, min(motion.duration_s, 10), step)])
        spectrum = np.abs(np.fft.rfft(np.diff(dense, axis=0) * np.hanning(len(dense) - 1)[:, None], axis=0)).sum(axis=1)
        row[2].plot(np.fft.rfftfreq(len(dense) - 1, step), spectrum, color=COLOURS["ours"])
        row[2].axvspan(8, 12, color="#fdebd0", zorder=0)
        row[2].set(xlim=(0, 20), yscale="log", xlabel="frequency (Hz)", ylabel="amplitude, arbitrary unit")
        row[2].set_xticks(range(0, 20, 4))
        row[2].set_title("Velocity spectrum (tremor: 8 to 12 Hz)")
    return page


def volume_page(recording: Recording) -> Figure:
    """Positions of the landmarks across the view and in depth, and distance between the tips over time.

    Positions are the labels in the left image, or the robot's x and y if there are no labels.  Depth is along the left
    camera's true viewing direction if that is known, else along the robot's z.
    """
    page, axes = figure(1, 3, width_in=12, height_in=3.6)
    x, labels, truth = recording.landmarks_mm(), recording.annotations, recording.truth
    across = labels.u_left if labels else x[..., :2]
    depth = truth.rig.left.viewing_direction if truth else np.array([0.0, 0.0, 1.0])
    for k, (name, colour) in enumerate(LANDMARK_COLOURS.items()):
        axes[0].plot(*across[:, k].T, "o", color=colour, markeredgecolor="black", markersize=5, label=name)
        z = (x[:, k] - np.nanmean(x, axis=(0, 1))) @ depth
        axes[1].plot(z, np.full(len(z), k), "o", color=colour, alpha=0.6, markeredgecolor="black", markeredgewidth=0.4)
    if labels:
        width, height = recording.image_size_px
        axes[0].set(xlim=(0, width), ylim=(height, 0), title="Labels, left image (px)")
    else:
        axes[0].set(xlabel="x (mm)", ylabel="y (mm)", title="Positions reported by the robot")
    axes[0].set_aspect("equal")
    page.legend(*axes[0].get_legend_handles_labels(), fontsize=8, loc="outside lower left", ncols=3)
    axes[1].set(xlabel=f"{'depth' if truth else 'robot z'} minus its mean (mm)", title="Depths of the landmarks")
    axes[1].set_yticks(range(3), LANDMARK_COLOURS)
    axes[1].set_ylim(2.6, -0.6)
    axes[2].plot(recording.frames.time_s, np.linalg.norm(x[:, 1] - x[:, 2], axis=1), "o-", color=COLOURS["ours"])
    axes[2].set(xlabel="time (s)", ylabel="mm", title="Distance between the tips")
    return page


def annotation_errors(recording: Recording) -> np.ndarray:
    """Errors (n, 2) px of the clicked landmarks in both images.  Raises ValueError without truth or labels."""
    if recording.truth is None or recording.annotations is None:
        raise ValueError(f"recording: {recording.name} has no truth or no annotations; give a simulated recording.")
    errors = [
        (getattr(recording.annotations, f"u_{side}") - getattr(recording.truth, f"u_{side}")).reshape(-1, 2)
        for side in ("left", "right")
    ]
    errors = np.concatenate(errors)
    return errors[np.isfinite(errors).all(axis=1)]


def realism_page(real: Mapping[str, np.ndarray], simulated: Mapping[str, np.ndarray]) -> Figure:
    """Distribution of each statistic in real and simulated windows; a band spans the real 5th to 95th percentile.

    Both arguments map a statistic to its values (n,).
    """
    columns = 4
    rows = -(-len(real) // columns)
    page, axes = figure(rows, columns, width_in=12, height_in=2.1 * rows, squeeze=False)
    for ax in axes.flat[len(real) :]:
        ax.set_axis_off()
    for ax, name in zip(axes.flat, real, strict=False):
        low, high = np.percentile(np.concatenate([real[name], simulated[name]]), [1, 97])
        bins = np.linspace(low, high if high > low else low + 1, 18)
        ax.axvspan(*np.percentile(real[name], [5, 95]), color="#eeeeee", zorder=0)
        ax.hist(real[name], bins=bins, density=True, color=COLOURS["baseline"], alpha=0.8, label="real")
        ax.hist(simulated[name], bins=bins, density=True, histtype="step", color=COLOURS["ours"], label="simulated")
        ax.axvline(np.median(simulated[name]), color=COLOURS["ours"], linestyle="--", linewidth=1)
        ax.set(yticks=[], title=name.replace("_", " "))
        ax.title.set_fontsize(9)
    axes.flat[0].legend(fontsize=7)
    return page


def verdict_page(judgements: Mapping[str, Sequence[Mapping]]) -> Figure:
    """Position of the simulated median in the range of the real frames, for each statistic.

    Parameters
    ----------
    judgements:
        Name of a comparison -> its rows from `notebooks.studies.realism.compare`.
    """
    page, ax = figure(width_in=9, height_in=4.6)
    markers = zip(judgements.items(), "osDv^P", COLOURS.values(), strict=False)
    for k, ((name, rows), marker, colour) in enumerate(markers):
        place = np.array([(r["simulated_median"] - r["real_p05"]) / (r["real_p95"] - r["real_p05"]) for r in rows])
        y = np.arange(len(rows)) + 0.12 * (k - (len(judgements) - 1) / 2)
        ax.plot(place.clip(-0.6, 1.6), y, marker, color=colour, label=name, markersize=6)
    ax.axvspan(0, 1, color="#eeeeee", zorder=0)
    ax.set_yticks(range(len(rows)), [r["name"].replace("_", " ") for r in rows])
    ax.set(xlim=(-0.65, 1.65), xlabel="0: 5th percentile of real frames, 1: 95th (values beyond the axis: at its end)")
    ax.set_title("Median of the simulated windows")
    ax.invert_yaxis()
    ax.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return page


def stages_page(seconds: Mapping[str, float]) -> Figure:
    """CPU seconds that each stage of the simulator takes for a stereo pair, as bars."""
    page, ax = figure(width_in=8, height_in=0.35 * len(seconds) + 0.9)
    ax.barh(list(seconds), list(seconds.values()), color=COLOURS["baseline"])
    ax.invert_yaxis()
    ax.set(xlabel="CPU seconds per stereo pair")
    return page


def profiles_page(pairs: Mapping[str, tuple[Profiles, Profiles]]) -> Figure:
    """Luminance, colour, gradients and power spectrum of real and simulated images, a row for each pair (real, simulated).

    Lines are means over images; the grey band holds the middle 90 % of the real images.
    """
    page, axes = figure(len(pairs), 4, width_in=12, height_in=2.6 * len(pairs), squeeze=False)
    channels = dict(zip(("red", "green", "blue"), ("#c0392b", "#2e8b57", "#2b6cc0"), strict=True))
    for row, (name, (real, simulated)) in zip(axes, pairs.items(), strict=True):
        curves = (
            ("level", "luminance", "luminance", f"{name}: luminance"),
            ("slope", "gradient", "derivative along x (1/px)", "Gradients"),
            ("frequency", "power", "frequency (cycles/px)", "Power spectrum"),
        )
        for ax, (x, y, label, title) in zip((row[0], row[2], row[3]), curves, strict=True):
            low, high = np.percentile(getattr(real, y), [5, 95], axis=0)
            ax.fill_between(getattr(real, x), low, high, color="#e4e4e4", zorder=0)
            for profile, colour, kind in ((real, "#555555", "real"), (simulated, COLOURS["ours"], "simulated")):
                ax.plot(getattr(profile, x), getattr(profile, y).mean(axis=0), color=colour, label=kind)
            ax.set(xlabel=label, title=title)
        for k, (channel, colour) in enumerate(channels.items()):
            row[1].plot(real.level, real.colour[:, k].mean(axis=0), color=colour, linewidth=1.2, label=channel)
            row[1].plot(simulated.level, simulated.colour[:, k].mean(axis=0), "--", color=colour)
        row[1].set(xlabel="red, green, blue", title="Colour (dashed: simulated)", ylim=(0, None))
        row[0].set(ylim=(0, None))
        row[2].set(yscale="log", ylim=(1e-3, None))
        row[3].set(xscale="log", yscale="log")
        row[3].set_xticks([0.03, 0.1, 0.3], ["0.03", "0.1", "0.3"])
        row[3].xaxis.set_minor_formatter(NullFormatter())
    axes[0, 0].legend(fontsize=8)
    return page


def realism_sheet(
    pairs: Mapping[str, tuple[Sequence[np.ndarray], Sequence[np.ndarray]]], *, columns: int = 8
) -> Figure:
    """Rows of real windows, each above a row of simulated windows."""
    page, axes = figure(2 * len(pairs), columns, width_in=12, height_in=3.1 * len(pairs), squeeze=False)
    rows = [
        (f"{kind}, {name}", images)
        for name, pair in pairs.items()
        for kind, images in zip(("real", "simulated"), pair, strict=True)
    ]
    for line, (title, images) in zip(axes, rows, strict=True):
        for k, ax in enumerate(line):
            show_image(ax, images[k * len(images) // columns], title if k == 0 else "")
            ax.title.set_fontsize(9)
    return page


def landmark_counts(recordings: Sequence[Recording]) -> dict[str, dict[str, int]]:
    """Landmark -> number of images of both cameras in which it is visible, hidden by the tool, outside, and near a glint.

    Raises ValueError for a recording without truth.
    """
    truths = [recording.truth for recording in recordings]
    if None in truths:
        raise ValueError("recordings: one has no truth; give simulated recordings.")
    visibility = np.concatenate([np.stack([t.visibility_left, t.visibility_right]) for t in truths], axis=1)
    counts = {
        name: {
            "visible": int((visibility[..., k] == 2).sum()),
            "hidden": int((visibility[..., k] == 1).sum()),
            "outside": int((visibility[..., k] == 0).sum()),
        }
        for k, name in enumerate(LANDMARKS)
    }
    if all(t.in_glint_left is not None for t in truths):
        in_glint = np.concatenate([np.stack([t.in_glint_left, t.in_glint_right]) for t in truths], axis=1)
        for k, name in enumerate(LANDMARKS):
            counts[name]["in_glint"] = int(in_glint[..., k].sum())
    return counts


def ray_cast_depth(scene: Scene, window: Window, u: np.ndarray, *, step_mm: float = 0.01) -> np.ndarray | None:
    """Depth z (n,) mm of a scene at pixels u (n, 2) by Open3D's ray caster; None if Open3D cannot be imported.

    The surface becomes a mesh with triangles of `step_mm`.  Rays start far above it.  Only the height field and the camera
    are shared with our renderer.
    """
    try:
        o3d = open3d()
    except ImportError as error:
        print(f"Skipped: {error}")
        return None
    low, high = (np.stack(window.rays(u.T, np.full(len(u), z)), axis=1) for z in (-20.0, 20.0))
    corners = np.vstack([np.stack(window.rays(u.T, np.full(len(u), z)), axis=1) for z in (-4.0, 4.0)])
    box = zip(corners.min(axis=0) - step_mm, corners.max(axis=0) + step_mm, strict=True)
    x, y = (np.arange(a, b, step_mm) for a, b in box)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    z = scene.height(grid[..., 0], grid[..., 1])
    vertices = np.dstack([grid, z]).reshape(-1, 3).astype(np.float32)
    first = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    right, below = first + 1, first + len(x)
    triangles = np.concatenate([np.stack([first, right, below], 1), np.stack([right, below + 1, below], 1)])
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles.astype(np.uint32)))
    start, end = np.column_stack([low, np.full(len(u), -20.0)]), np.column_stack([high, np.full(len(u), 20.0)])
    rays = np.hstack([start, end - start]).astype(np.float32)
    share = caster.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    return start[:, 2] + share * (end - start)[:, 2]
