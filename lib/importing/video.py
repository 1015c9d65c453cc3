"""Reads stereo frames from videos of any codec and from image files, as 8-bit RGB with the true time of each."""

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise, takewhile
from pathlib import Path, PurePath

import av
import cv2
import numpy as np
from PIL import Image
from scipy.spatial import KDTree

from lib.importing.logs import exact_seconds, increasing, read_columns, since
from lib.importing.mapping import Video
from lib.recordings import read_image, to_8_bits

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".wmv", ".ts")
_STEP_S = 1e-4, 60.0  # plausible median step of frames; outside this range the unit of time must be wrong
_DEPTH_SAMPLES = 12  # number of frames in which the brightest value is searched
_LOST = 1.5  # a step between frames, in usual steps, above which a frame is missing between them
_SQUARE = 0.02  # largest difference of a pixel's width over height from 1 that does not matter
_DECIMAL = re.compile(r"(?<![\d.])(\d+\.|\d{10}[_-])(\d{1,9})$")  # over 9 digits after a point are a time themselves


def last_number(path: str | PurePath) -> int | None:
    """The last whole number in a file's name, which is its frame number or its time.

    >>> last_number("cam0/frame_000012.png")
    12
    """
    found = re.findall(r"\d+", Path(path).stem)
    return int(found[-1]) if found else None


def decimals(files: Sequence[Path]) -> list[Decimal]:
    """The decimal numbers at the end of the files' names, which are seconds in dumps of ROS; empty if there are none.

    >>> decimals([Path("cam0/1700000000.250000.png"), Path("cam0/1700000000_500000.png")])
    [Decimal('1700000000.250000'), Decimal('1700000000.500000')]
    """
    found = [_DECIMAL.search(path.stem) for path in files]
    digits, whole = {m and len(m[2]) for m in found}, {int(m[1][:-1]) for m in found if m}
    if len(digits) > 1 and len(whole) < 2 and max(whole, default=0) < 10**9:
        return []  # versions or counters, as in v1.9, v1.10
    if len(digits) > 1:  # .5 may be half a second or 5 ns
        what = f"some names end on a decimal number, but not all, or not with as many digits ({len(digits)} kinds)"
        raise ValueError(f"{files[0].parent}: {what}. Number the files 000000, 000001, ..., and give their times in a table.")
    return [Decimal(f"{m[1][:-1]}.{m[2]}") for m in found if m]


class _Images:
    """Image files in the order of the numbers in their names."""

    def __init__(self, folder: Path, pattern: str) -> None:
        if Path(pattern).is_absolute():
            raise ValueError(f"{pattern}: name the images relative to {folder}, such as left/*.png.")
        files = (path for path in folder.glob(pattern) if path.name[0] != ".")  # macOS writes ._000000.png beside 000000.png
        if not (found := [path for path in files if path.suffix.lower() in IMAGES]):
            raise FileNotFoundError(f"{folder / pattern}: no image ({', '.join(IMAGES)}) matches the mapping's pattern.")
        if bad := [path for path in found if last_number(path) is None]:
            raise ValueError(f"{min(bad)}: the name holds no number, so its order is unknown. Number the files.")
        seconds = decimals(found)
        order = sorted(zip(seconds or map(last_number, found), found, strict=True))
        self.in_names, self.files = [number for number, _ in order], [path for _, path in order]
        for (one, path), (other, later) in pairwise(order):
            if one == other:
                raise ValueError(f"{later}: has the same number as {path.name}. Narrow the pattern to one camera.")
        self.stamps, exif = None, _orientation(self.files[0])
        self.turned, self.stated = f"has the EXIF orientation {exif}" if exif > 1 else "", {}
        counted = last_number(self.files[-1]) < 10 * len(self.files) + 10**6  # else the numbers are times
        counted &= len(set(map(int, seconds))) < 2
        self.numbers = {path.stem: n for n, path in enumerate(self.files)}
        self.numbers |= {last_number(path): n for n, path in enumerate(self.files) if counted}

    def __len__(self) -> int:
        return len(self.files)

    def read(self, wanted: np.ndarray) -> Iterator[np.ndarray]:
        return (read_image(self.files[index], bit_depth=None, upright=True) for index in wanted)


def _orientation(path: Path) -> int:
    """The EXIF orientation of an image, 1 to 8, with which programs show it."""
    with suppress(OSError, SyntaxError, ValueError), Image.open(path) as image:  # reads the header only
        for text in ("xmp", "XML:com.adobe.xmp"):  # Pillow also looks there, OpenCV does not
            image.info.pop(text, None)
        found = image.getexif().get(0x0112, 1)
        return found if found in range(1, 9) else 1
    return 1


def quarters(frame: av.VideoFrame | None) -> int:
    """Quarter turns, anticlockwise, by which players show a frame of a video (its display matrix); 0 for None."""
    return round(frame.rotation / 90) if frame else 0


def stated(stream: av.VideoStream, first: av.VideoFrame | None) -> dict[str, float | bool]:
    """Keys of a mapping for unusual pixels and rows that a video states; `first` is its first frame."""
    aspect = round(float(stream.sample_aspect_ratio or 1) ** (-1 if quarters(first) % 2 else 1), 4)
    keys = {"pixel_aspect": aspect} if abs(aspect - 1) > _SQUARE else {}
    return keys | ({"deinterlace": True} if first and first.interlaced_frame else {})


def deinterlaced(image: np.ndarray) -> np.ndarray:
    """The even rows of an image (h, w, 3) uint8, which are of one instant; each odd row is the mean of its neighbours.

    >>> deinterlaced(np.uint8([[0], [9], [2], [9]])[..., None])[:, 0, 0]
    array([0, 1, 2, 2], dtype=uint8)
    """
    even, found = image[::2], image.copy()
    below = np.concatenate([even[1:], even[-1:]])[: len(image) // 2]
    found[1::2] = (even[: len(below)].astype(np.uint16) + below + 1) // 2
    return found


class _Film:
    """A video file, decoded from its start; times are those of its container."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such video; the mapping names it.")
        self.path, self.files, self.numbers = path, [path], {}
        with self._open() as container:
            stream, kinds = container.streams.video[0], container.format.name.split(",")
            packets = [(p.is_discard, p.pts, p.dts) for p in container.demux(stream) if p.size]
            timed = not stream.frames and len(container.streams) == 1  # such as .mkv, which states only its duration
            end_s = (container.duration or 0) / av.time_base if timed else 0.0
            listed = len(stream.index_entries) if "mp4" in kinds else stream.frames  # .mp4 lists less if it is trimmed
            count = listed if stream.frames else len(packets)
            self.stated = stated(stream, first := next(self._decoded(), None))
        base = Decimal(stream.time_base.numerator) / Decimal(stream.time_base.denominator)
        times = [own for discarded, *own in packets if not discarded]  # a trimmed .mp4 still holds what it does not show
        # .avi has only times of decoding (dts), which frames do not carry.
        counted = "avi" in kinds or any(pts is None for pts, _ in times)
        ticks = sorted(pair[counted] for pair in times if pair[counted] is not None)
        whole = len(packets) == count and 0 < len(ticks) == len(times)
        if not whole or (end_s and float(base) * (ticks[-1] + 2.5 * (ticks[-1] - ticks[0]) / len(ticks)) + 0.2 < end_s):
            raise ValueError(f"{path}: the video is cut off: {len(packets)} of {count} frames, {end_s:.1f} s. Copy it again.")
        self._quarters = quarters(first)
        way = "" if self._quarters % 2 == 0 else " anticlockwise" if self._quarters > 0 else " clockwise"
        self.turned = f"states that it is shown turned by {90 * abs(self._quarters)} degrees{way}" if self._quarters else ""
        if first and (matrix := first.side_data.get("DISPLAYMATRIX")) is not None:
            a, b, _, c, d, *_ = np.frombuffer(matrix, np.int32).astype(float)
            if a * d < b * c:
                raise ValueError(f"{path}: states that it is shown mirrored. Mirror its pixels (`ffmpeg -i` does).")
        if first and not counted and first.pts in ticks:  # nothing before the first key frame can be decoded
            ticks = ticks[ticks.index(first.pts) :]
        self.stamps, self._ticks = [tick * base for tick in ticks], [] if counted else ticks

    def _open(self) -> av.container.InputContainer:
        try:
            container = av.open(str(self.path))
        except (av.error.FFmpegError, ValueError) as error:
            cure = "Copy it again, or convert it to H.264 in an .mp4 file"
            raise ValueError(f"{self.path}: the video cannot be opened ({error}). {cure}.") from None
        if not container.streams.video or container.streams.video[0].codec_context is None:
            container.close()
            raise ValueError(f"{self.path}: no video of a known codec. Convert it to H.264 in an .mp4 file.")
        return container

    def __len__(self) -> int:
        return len(self.stamps)

    def _decoded(self) -> Iterator[av.VideoFrame]:
        """The frames that the decoder gives, up to one that it cannot decode."""
        with self._open() as container, suppress(av.error.FFmpegError):
            container.streams.video[0].thread_type = "AUTO"
            yield from container.decode(video=0)

    def read(self, wanted: np.ndarray) -> Iterator[np.ndarray]:
        frames, wanted = self._decoded(), set(map(int, wanted))
        for index in range(max(wanted) + 1):
            frame = next(frames, None)
            if frame is None or frame.is_corrupt or (self._ticks and frame.pts != self._ticks[index]):
                what = f"frame {index} of {len(self)} cannot be decoded"
                raise ValueError(f"{self.path}: {what}. The video is damaged; copy or convert it again.")
            if index in wanted:
                deep = max(c.bits for c in frame.format.components) == 16
                # A camera may use 12 of 16 bits.  Formats of fewer bits state their depth, so PyAV scales them to 8.
                image = frame.to_ndarray(format="rgb48le" if deep else "rgb24")
                yield np.ascontiguousarray(np.rot90(image, self._quarters))


@dataclass(frozen=True, eq=False)
class StereoSource:
    """Pairs of frames, with the exact time of each."""

    reels: tuple[_Images | _Film, ...]  # left and right, or one that holds both views
    video: Video
    index: np.ndarray  # (n, 2) left and right frame of each pair
    time: list[Decimal]
    bit_depths: list[int | None]  # of each reel: bits used by 16-bit frames, which are scaled to 8; None for 8-bit frames
    dropped: int  # number of frames that have no partner
    notes: list[str]  # sentences on what was read otherwise than it stands in the files

    def pairs(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Left and right images, (h, w, 3) uint8 RGB."""
        usual: list[str] = []  # the sizes of the first frames
        frames = zip(*(reel.read(index) for reel, index in zip(self.reels, self.index.T, strict=False)), strict=True)
        for index, images in zip(self.index, frames, strict=True):
            numbered = zip(self.reels, index, strict=False)
            places = [reel.files[i] if isinstance(reel, _Images) else f"{reel.path}, frame {i}" for reel, i in numbered]
            images = [to_8_bits(*view) for view in zip(images, self.bit_depths, map(Path, places), strict=True)]
            sizes = [f"{image.shape[1]} x {image.shape[0]} px" for image in images]
            usual = usual or sizes
            for place, size, first in zip(places, sizes, usual, strict=True):
                if size != first:
                    raise ValueError(f"{place}: it has {size}, but the frames before it {first}. Export all alike.")
            images = [deinterlaced(image) for image in images] if self.video.deinterlace else images
            if self.video.layout != "two":
                axis = 1 if self.video.layout == "side_by_side" else 0
                if images[0].shape[axis] % 2:
                    raise ValueError(f"{places[0]}: images of {sizes[0]} do not split into equal halves. Check layout.")
                images = np.split(images[0], 2, axis=axis)
            turns = self.video.rotate_left, self.video.rotate_right
            images = images[::-1] if self.video.exchanged else images
            if (aspect := self.video.pixel_aspect) != 1:
                fx, fy = max(aspect, 1.0), max(1 / aspect, 1.0)
                images = [cv2.resize(image, None, fx=fx, fy=fy, interpolation=cv2.INTER_CUBIC) for image in images]
            left, right = (np.rot90(image, -turn // 90) for image, turn in zip(images, turns, strict=True))
            if left.shape != right.shape and not (any(turns) and sorted(left.shape) == sorted(right.shape)):
                what = f"left and right frames differ in size ({' and '.join(sizes)})"
                cure = "export both alike. If one camera is turned, set video.rotate_left or video.rotate_right"
                raise ValueError(f"{places[-1]}: {what}; {cure}.")
            # Black at the right and at the bottom makes sizes equal; there, pixels keep their coordinates.
            size = np.maximum(left.shape, right.shape)
            yield tuple(np.pad(i, [(0, more) for more in size - i.shape]) if any(turns) else i for i in (left, right))


def open_stereo(folder: Path, video: Video) -> StereoSource:
    """Open the frames that a mapping describes; images are decoded when they are read."""
    names = [video.left, video.right] if video.layout == "two" else [video.file]
    reels = tuple(_Film(folder / n) if Path(n).suffix.lower() in VIDEOS else _Images(folder, n) for n in names)
    if len(reels) == 2 and (shared := sorted({*reels[0].files} & {*reels[1].files})):
        raise ValueError(f"{shared[0]}: video.left and video.right both take it. Name each camera's own files.")
    notes = [f"{reel.files[0].name} {reel.turned}; its camera's images were turned so." for reel in reels if reel.turned]
    for reel in reels:
        if (aspect := reel.stated.get("pixel_aspect", 1)) != 1 and video.pixel_aspect == 1:
            what = f"states pixels {aspect:g} times as wide as high: if circles look like ellipses in the recording"
            notes.append(f"{reel.files[0].name} {what}, import again with video.pixel_aspect = {aspect:g}.")
        if "deinterlace" in reel.stated and not video.deinterlace:
            what = "states that it is interlaced: if a moving tool has edges like combs"
            notes.append(f"{reel.files[0].name} {what}, import again with video.deinterlace = true.")
    times = [_times(folder, video, reel, place, notes) for reel, place in zip(reels, _places(reels), strict=True)]
    for reel, time in zip(reels, times, strict=True):
        increasing(time, str(reel.files[0]), _STEP_S, "name_unit" if video.times == "names" else "time_unit")
    index = _paired(folder, times)
    start, end_s = times[0][0], np.inf if video.end_s is None else video.end_s
    kept = [pair for pair in index[:: video.every] if (video.start_s or 0) <= times[0][pair[0]] - start <= end_s]
    if not kept:
        raise ValueError(f"{folder}: no frame lies between start_s and end_s; the video lasts {times[0][-1] - start} s.")
    dropped, index = sum(map(len, times)) - len(reels) * len(index), np.array(kept)
    time = [times[0][i] for i in index[:, 0]]
    depths = [video.bit_depth] * len(reels) if video.bit_depth else _bit_depths(reels, index)
    return StereoSource(reels, video, index, time, depths, dropped, list(dict.fromkeys(notes)))


def _places(reels: Sequence[_Images | _Film]) -> list[np.ndarray]:
    """Each source's frame numbers, from 0.  Evenly numbered images keep gaps, also at the start if one counter made both."""
    numbers = [np.array([number for number in reel.numbers if isinstance(number, int)]) for reel in reels]
    steps = np.concatenate([np.diff(own) for own in numbers])
    usual = max(np.median(steps), 1) if steps.size else 1
    if (steps % usual).any() or any(len(own) != len(reel) for own, reel in zip(numbers, reels, strict=True)):
        return [np.arange(len(reel)) for reel in reels]
    first, last = zip(*((own[0], own[-1]) for own in numbers), strict=True)
    together = max(first) <= min(last) and not np.ptp(first) % usual  # then one counter triggers both cameras
    return [(own - (min(first) if together else own[0])) // usual for own in numbers]


def _times(folder: Path, video: Video, reel: _Images | _Film, places: np.ndarray, notes: list[str]) -> list[Decimal]:
    if video.times == "fps":
        return [Decimal(int(place)) / Decimal(str(video.fps)) for place in places]
    if video.times == "names" and reel.stamps is None:
        return [exact_seconds(str(n), video.name_unit, str(p)) for n, p in zip(reel.in_names, reel.files, strict=True)]
    if video.times == "table":
        time, _, rows = read_columns(folder / video.table.file, video.table, [], notes)
        increasing(time, str(folder / video.table.file), _STEP_S, "time_unit", rows)
        if len(time) != len(reel):
            raise ValueError(f"{folder / video.table.file}: {len(time)} times for {len(reel)} frames of {reel.files[0]}.")
        return time
    if reel.stamps is None or video.times == "names":
        raise ValueError(f"{reel.files[0]}: has no times of this kind; set video.times to fps, table, names or container.")
    if repeats := len(reel.stamps) - len(set(reel.stamps)):
        cure = 'Set video.times = "fps" with their rate, or "table" with a table of their times'
        raise ValueError(f"{reel.path}: {repeats} of its {len(reel)} frames have the time of another one. {cure}.")
    return reel.stamps


def _paired(folder: Path, times: list[list[Decimal]]) -> np.ndarray:
    """(n, 2) left and right frames that are nearest in time, less than half a frame apart."""
    if len(times) == 1:
        return np.repeat(np.arange(len(times[0]))[:, None], 2, axis=1)
    left, right = (since(time, times[0][0]) for time in times)
    distance, partner = KDTree(right[:, None]).query(left[:, None])
    good = distance < 0.5 * (float(np.median(np.diff(left))) if len(left) > 1 else 1.0)
    index = np.column_stack([np.flatnonzero(good), partner[good]])
    index = index[np.unique(index[:, 1], return_index=True)[1]]
    if 2 * len(index) < min(len(left), len(right)):
        what = f"only {len(index)} of {len(left)} left and {len(right)} right frames lie within half a frame of each other"
        raise ValueError(f"{folder}: {what}. Left and right need one clock; with video.times = 'fps' frames pair by number.")
    even = all(len(side) > 1 and np.diff(side).max() < _LOST * np.median(np.diff(side)) for side in (left, right))
    if even and len(left) != len(right) and (index == np.arange(len(index))[:, None]).all():  # the rest is at the end
        what = f"{len(left)} left and {len(right)} right frames, both at a steady rate; those at the end have no partner"
        why = "If one camera lost frames before, later pairs are of different instants"
        warnings.warn(f"{folder}: {what}. {why}: `python3 -m lib check` on the recording finds out.", stacklevel=2)
    return index


def _bit_depths(reels: tuple[_Images | _Film, ...], index: np.ndarray) -> list[int | None]:
    """The fewest of 8, 10, 12, 14, 16 bits that hold the brightest value of sampled 16-bit frames; None for 8-bit frames.

    Cameras that are about equally bright have one depth; else a glint in one view would make the other one brighter.
    """
    some = index[np.unique(np.linspace(0, len(index) - 1, _DEPTH_SAMPLES).astype(int))]
    depths, means = [], []
    for reel, wanted in zip(reels, some.T, strict=False):
        if isinstance(reel, _Film):
            wanted = wanted[: max(1, len(wanted) // 4)]  # since a video is decoded from its start
        deep = takewhile(lambda image: image.dtype != np.uint8, reel.read(wanted))  # one camera may have 8, the other 16
        values = [(int(image.max()), float(image.mean())) for image in deep]
        brightest, mean = np.max(values or [(0, 0)], axis=0)
        depths.append(next(bits for bits in (8, 10, 12, 14, 16) if brightest < 1 << bits) if values else None)
        means.append(mean)
    same = None not in depths and max(means) < 2 * min(means)  # a step of depth is a factor of 4
    return [max(depths)] * len(depths) if same else depths
