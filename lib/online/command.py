"""``python3 -m lib online RECORDING``."""

import argparse
import contextlib
import sys
import time
from collections import Counter, deque
from pathlib import Path

import numpy as np

from lib.correspondences import LANDMARKS
from lib.landmarks import Detector
from lib.online.feeds import Live, Recorder, recorded
from lib.online.pipeline import OnlinePipeline
from lib.online.result import FrameResult, Settings
from lib.online.video import Dashboard, video_file
from lib.recordings import Recording


class Tally:
    """Statistics of a run, in constant memory; the latencies, from arrival to distance, are of the newest 100,000 frames."""

    def __init__(self) -> None:
        self.start, self.cpu_start = time.monotonic(), time.process_time()
        self.states, self.failures, self.latency_s = Counter(), Counter(), deque(maxlen=100_000)
        self.surfaces, self.dropped, self.newest = 0, 0, None

    def add(self, result: FrameResult, latency_s: float) -> None:
        """Count a frame."""
        self.surfaces += result.reconstructed_at not in (None, self.newest)
        self.dropped, self.newest = result.dropped, result.reconstructed_at
        self.states[result.state] += 1
        self.failures.update(result.failures.keys())
        self.latency_s.append(latency_s)

    def __str__(self) -> str:
        n, spent, cpu = self.states.total(), time.monotonic() - self.start, time.process_time() - self.cpu_start
        median, late = 1e3 * np.quantile(self.latency_s or [np.nan], (0.5, 0.99))
        states = ", ".join(f"{state} {n}" for state, n in self.states.most_common())
        failures = ", ".join(f"{name} {n}" for name, n in self.failures.most_common()) or "none"
        return (
            f"{n} frames in {spent:.1f} s, {n / spent:.1f} per second; processor time {cpu / max(n, 1):.3f} s per frame\n"
            f"{self.surfaces} surfaces, {self.surfaces / spent:.1f} per second; {self.dropped} dropped\n"
            f"latency from frame to distance: {median:.0f} ms median, {late:.0f} ms 99th percentile\n"
            f"states: {states}\nfailures: {failures}{_memory()}"
        )


def _memory() -> str:
    """A line with the peak memory of this process, or "" on Windows, which does not report it."""
    with contextlib.suppress(ImportError):
        import resource

        unit = 2**20 if sys.platform == "darwin" else 2**10
        return f"\nmemory: at most {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit:.0f} MB"
    return ""


def main(argv: list[str] | None = None) -> int:
    """`python3 -m lib online`: run the online system over a recording, as fast as possible or in real time."""
    parser = argparse.ArgumentParser(prog="python3 -m lib online", description=main.__doc__.split(": ", 1)[1])
    add = parser.add_argument
    add("recording", type=Path)
    add("--live", action="store_true", help="frames come in real time and may be lost; surfaces are made in another process")
    add("--record", type=Path, metavar="FOLDER", help="write inputs and outputs; FOLDER/input is a recording")
    add("--video", type=Path, metavar="FILE.mp4", help="write a video of images, states and distances")
    add("--weights", type=Path, help="detector (default: the one that ships)")
    add("--frames", metavar="A:B", help="use frames A to B - 1 (default: all); --frames=-10: uses the last ten")
    add("--surface-every", type=int, default=1, help="reconstruct the surface in every N-th frame")
    a = parser.parse_args(argv)
    if a.surface_every < 1:
        parser.error("--surface-every: must be at least 1.")
    recording = Recording.open(a.recording)
    if recording.skeleton != LANDMARKS:
        names = ", ".join(recording.skeleton)
        raise ValueError(f"{a.recording}: its landmarks are {names}; the online system follows {', '.join(LANDMARKS)}.")
    settings = Settings(surface_every=a.surface_every, fps=recording.fps, robot_accuracy_mm=recording.robot_accuracy_mm)
    detector = Detector.load(a.weights)
    frames = recorded(recording, None if a.frames is None else recording.frames_of(a.frames))
    recorder = None
    feed = Live(frames) if a.live else frames
    with contextlib.ExitStack() as stack:
        show = stack.enter_context(video_file(a.video, min(recording.fps, 25.0))) if a.video else None
        if a.record:
            recorder = Recorder(a.record, recording, patient=not a.live)
            stack.callback(recorder.close)
        pipeline = stack.enter_context(OnlinePipeline(detector, settings=settings, beside=a.live))
        tally, page, state, said = Tally(), Dashboard(), "", {}
        for arrival in feed:
            start = arrival.arrived_s if a.live else time.monotonic()
            result = pipeline.step(arrival.left, arrival.right, arrival.kinematics, time_s=arrival.time_s)
            tally.add(result, time.monotonic() - start)
            near = "; the cameras have a finite distance" if np.isfinite(result.working_distance_mm) else ""
            if (now := result.state + f": {result.cause}" * bool(result.cause) + near) != state:
                state = now
                print(f"frame {arrival.source:6d} {result.time_s:9.2f} s: {now}")
            for name, why in result.failures.items():
                if why != said.get(name) and why not in result.cause:
                    print(f"frame {arrival.source:6d} {name}: {why}", file=sys.stderr)
            said = result.failures
            if recorder:
                recorder.add(arrival, result)
            if show:
                show(page.draw(arrival.left, arrival.right, result))
    print(tally)
    if a.live:
        print(f"frames lost before they were processed: {feed.lost}")
    if recorder:
        print(recorder.failure or f"recorded in {recorder.folder}; frames left out of the record: {recorder.left_out}")
    return 0
