"""The stereo frames of a recording: folders of images or two videos, decoded when a frame is read."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import av
import cv2
import numpy as np
from PIL import Image

_SUFFIXES = (".jpg", ".jpeg", ".png")
#: Decodes the frame with a given number.
Reader = Callable[[int], np.ndarray]
_LOST_BYTES = 512  # length of a disk sector, which a crash or a bad copy may replace by zeros


@dataclass(frozen=True)
class StereoFrame:
    """One stereo pair: `left` and `right` (h, w, 3) uint8 RGB, read-only; `time_s` on the video clock."""

    left: np.ndarray
    right: np.ndarray
    time_s: float


def read_image(
    path: Path, image_size_px: tuple[int, int] | None = None, bit_depth: int | None = 0, *, upright: bool = False
) -> np.ndarray:
    """Read an image file, colour or grey, as (h, w, 3) uint8 RGB.  OpenCV turns a TIFF by its EXIF orientation.

    Args:
        image_size_px: Required (width, height).
        bit_depth: Number of bits that a 16-bit image uses, as in `to_8_bits`; None returns uint16.
        upright: Turn a JPEG or PNG by its EXIF orientation, too.

    Raises a ValueError if the image cannot be decoded, if a part of it is lost, or if it has another size.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image.")
    data = path.read_bytes()  # not cv2.imread: it fails on non-ASCII paths on some systems
    if bytes(_LOST_BYTES) in data and not _may_hold_zeros(data):
        raise ValueError(f"{path}: the image is corrupt; a block of zeros replaces a part of it. Export it again.")
    image, flags = None, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | (0 if upright else cv2.IMREAD_IGNORE_ORIENTATION)
    with suppress(cv2.error):  # raised for more pixels than OpenCV allows, and for no data
        image = cv2.imdecode(coded := np.frombuffer(data, np.uint8), flags)
        if path.suffix.lower() in (".tif", ".tiff") and cv2.imdecodemulti(coded, flags, range=(1, 2))[0]:
            raise ValueError(f"{path}: a TIFF of several pages, of which only the first would be read. Export single files.")
    if image is None:
        raise ValueError(f"{path}: the image is corrupt; it cannot be decoded. Export it again.")
    _check_size(path, (image.shape[1], image.shape[0]), image_size_px)
    return image if bit_depth is None else to_8_bits(image, bit_depth, path)


def to_8_bits(image: np.ndarray, bit_depth: int | None, path: Path) -> np.ndarray:
    """Scale an image (h, w, 3) to uint8: the range of the `bit_depth` bits that a 16-bit image uses becomes 0 to 255.

    >>> to_8_bits(np.full((1, 1, 3), 4095, np.uint16), 12, Path("dark.png")).max()
    np.uint8(255)
    """
    if image.dtype == np.uint8:
        return image
    if image.dtype != np.uint16:
        raise ValueError(f"{path}: pixels of type {image.dtype}; images of 8 or 16 bits work. Export it again.")
    if not bit_depth or image.max() >= 1 << bit_depth:
        why = f"more than bit_depth = {bit_depth} holds" if bit_depth else "and no bit_depth is stated"
        cure = "State what the camera uses, such as 12: bit_depth in recording.toml, video.bit_depth in an import's mapping"
        raise ValueError(f"{path}: 16-bit values up to {image.max()}, {why}. {cure}.")
    return np.rint(np.arange(1 << bit_depth) * (255 / ((1 << bit_depth) - 1))).astype(np.uint8)[image]


def encoded(image: np.ndarray, suffix: str, *options: int) -> bytes:
    """The bytes of an image file, such as ".png", for (h, w, 3) uint8 RGB; `options` are those of `cv2.imencode`."""
    return cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)[1].tobytes()


def _may_hold_zeros(data: bytes) -> bool:
    """False for a JPEG in which a long run of zeros must be damage; OpenCV decodes it without an error.

    Zeros are valid image data only if zero bits mean "end of block" in every AC table, as in tables that an encoder
    optimised for a flat image.  In a progressive JPEG they are always valid.  PNG files have check sums.
    """
    at, ends_block = 2, []
    while data[:2] == b"\xff\xd8" and data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] not in (b"\xc2", b"\xda"):
        after = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        table = at + 4 if data[at + 1] == 0xC4 else after
        while table + 17 < min(after, len(data)):  # class and number, 16 counts, symbols in the order of their codes
            if data[table] >> 4:
                ends_block.append(data[table + 17] == 0)
            table += 17 + sum(data[table + 1 : table + 17])
        at = after
    whole = bytes(_LOST_BYTES) not in data[at:]  # before that are tables and metadata, which may hold zeros
    return whole or data[:2] != b"\xff\xd8" or data[at + 1 : at + 2] == b"\xc2" or all(ends_block)


def _check_size(path: Path, size: tuple[int, int], expected: tuple[int, int] | None) -> None:
    if expected is not None and size != tuple(expected):
        raise ValueError(f"{path}: {size[0]} x {size[1]} px, but recording.toml states image_size_px = {list(expected)}.")


def open_side(folder: Path, side: str, image_size_px: tuple[int, int], bit_depth: int) -> tuple[int, Reader]:
    """The number of frames of one camera ("left" or "right"), and a function that decodes the frame with a given number."""
    images, video = folder / side, folder / f"{side}.mp4"
    if images.is_dir() and video.is_file():
        raise ValueError(f"{folder}: both {side}/ and {side}.mp4; keep one.")
    if video.is_file():
        return _open_video(video, image_size_px)
    if images.is_dir():
        return _open_images(images, image_size_px, bit_depth)
    raise FileNotFoundError(f"{folder}: no {side}/ folder of images and no {side}.mp4.")


def _open_images(folder: Path, image_size_px: tuple[int, int], bit_depth: int) -> tuple[int, Reader]:
    """Open images that are numbered from 0 without a gap; the header and the end of every file are checked here."""
    paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES), key=lambda p: p.stem.zfill(9))
    for index, path in enumerate(paths):
        if not path.stem.isdecimal():
            raise ValueError(f"{path}: frames are named by number, such as 000000{path.suffix}.")
        if int(path.stem) != index:
            what = f"frame {index:06d} is missing or named twice (found {path.name} in its place)"
            raise ValueError(f"{folder}: {what}. Frames are numbered from 000000 without a gap.")
        if not path.is_file():
            raise ValueError(f"{path}: not an ordinary file; copy the image to this place.")
        try:
            with warnings.catch_warnings(action="ignore"), Image.open(path) as image:  # reads the header only
                size = image.size
                orientation = image.getexif().get(0x0112, 1) if image.format == "JPEG" else 1
        except (OSError, SyntaxError, ValueError):
            raise ValueError(f"{path}: the image is corrupt; its header cannot be read. Export it again.") from None
        except Image.DecompressionBombError as error:
            raise ValueError(f"{path}: far larger than image_size_px ({error}). Export it again.") from None
        _check_size(path, size, image_size_px)
        if orientation != 1:
            cure = "Export it upright, without the orientation"
            raise ValueError(f"{path}: its EXIF orientation is {orientation}, so other programs rotate it. {cure}.")
        with path.open("rb") as stream:
            stream.seek(-min(path.stat().st_size, 32), 2)
            if (b"IEND" if path.suffix.lower() == ".png" else b"\xff\xd9") not in stream.read():
                raise ValueError(f"{path}: the image is cut off before its end. Export it again.")
    return len(paths), lambda index: read_image(paths[index], image_size_px, bit_depth)


def video_times(path: Path) -> np.ndarray:
    """Times (n,) s of a video's frames after the first: those of decoding, which lie as far apart as those of showing."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        listed = [entry.timestamp for entry in stream.index_entries if not entry.is_discard]  # without reading the images
        ticks = np.sort(listed or [p.pts for p in container.demux(stream) if p.pts is not None])
        return (ticks - ticks[:1]) * float(stream.time_base)


def _open_video(path: Path, image_size_px: tuple[int, int]) -> tuple[int, Reader]:
    """Open a video file.  Reading in order decodes each frame once; a jump seeks, or reads all between if the rate varies."""
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise ValueError(f"{path}: the video cannot be opened; H.264 or MPEG-4 in an .mp4 file works.")
    keys = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_COUNT)
    width, height, count = (int(capture.get(key)) for key in keys)
    _check_size(path, (width, height), image_size_px)
    following = 0

    @cache
    def steady() -> bool:
        """True if the frame rate is constant, which OpenCV assumes when it seeks."""
        times = video_times(path)
        return bool(np.abs(times - np.linspace(0, times[-1], len(times))).max() < 0.4 * times[-1] / len(times))

    def read(index: int) -> np.ndarray:
        nonlocal following
        if index < following or (index >= following + 32 and steady()):
            following = index if steady() else 0
            capture.set(cv2.CAP_PROP_POS_FRAMES, following)
        while following <= index:
            ok, image = capture.read()
            if not ok:
                raise ValueError(f"{path}: frame {following} of {count} cannot be decoded; the file is cut off.")
            following += 1
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    return count, read


class Frames(Sequence[StereoFrame]):
    """Stereo frames at times `time_s` (n,), video clock, strictly increasing.  Indexing decodes; four frames are cached."""

    def __init__(self, left: Reader, right: Reader, time_s: np.ndarray) -> None:
        self.time_s = np.array(time_s, dtype=np.float64)
        self.time_s.setflags(write=False)

        @lru_cache(4)
        def read(number: int) -> StereoFrame:
            images = left(number), right(number)
            for image in images:
                image.setflags(write=False)
            return StereoFrame(*images, float(time_s[number]))

        self._read = read

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, index: int) -> StereoFrame:
        try:
            number = range(len(self))[index]
        except IndexError:
            raise IndexError(f"frame {index}: the recording has {len(self)} frames.") from None
        return self._read(number)
