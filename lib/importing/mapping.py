"""The mapping file of an import: where the data are in the source, in which units and under which names."""

from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lib.correspondences import LANDMARKS
from lib.recordings.tables import read_toml

Vector = tuple[float, float, float]
Columns = tuple[str, str, str]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,31}$")]
Text = Annotated[str, Field(pattern=r"^[^<>&\x00-\x1f\x7f]*$")]  # because it is shown in web pages and terminals


class _Section(BaseModel):
    """A section of the file.  Pydantic calls its `model_post_init`, if any, which refuses keys that contradict each other."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Table(_Section):
    """A CSV or JSON file or a ROS bag, and its column of times.

    Columns of JSON are named as "pose.position.x" or "joints[0]", those of a bag as "/topic:field.of.the.message".
    """

    file: str
    separator: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Literal[".", ","] = "."
    time: str
    time_unit: Literal["s", "ms", "us", "ns", "iso", "hms"] = "s"


class Video(_Section):
    """The frames.  `left` and `right` are two videos or two patterns of image files; `file` holds both views."""

    layout: Literal["two", "side_by_side", "top_bottom"]
    left: str = ""
    right: str = ""
    file: str = ""
    exchanged: bool = False
    rotate_left: Literal[0, 90, 180, 270] = 0  # degrees clockwise, after the exchange
    rotate_right: Literal[0, 90, 180, 270] = 0
    deinterlace: bool = False
    pixel_aspect: Annotated[float, Field(ge=0.2, le=5)] = 1.0  # width over height in the files; pixels are made square
    times: Literal["container", "names", "table", "fps"] = "container"
    table: Table | None = None
    name_unit: Literal["s", "ms", "us", "ns"] = "ns"
    fps: Annotated[float, Field(gt=0)] | None = None
    bit_depth: Annotated[int, Field(ge=8, le=16)] | None = None
    every: Annotated[int, Field(ge=1)] = 1
    start_s: float | None = None  # `start_s`, `end_s` count from the first frame
    end_s: float | None = None
    format: Literal["jpg", "png"] = "jpg"
    jpeg_quality: Annotated[int, Field(ge=50, le=100)] = 95

    def model_post_init(self, _: object) -> None:
        wanted = [*(["left", "right"] if self.layout == "two" else ["file"]), *({self.times} & {"table", "fps"})]
        if missing := [key for key in wanted if not getattr(self, key)]:
            raise ValueError(f"layout {self.layout!r} with times {self.times!r} needs {' and '.join(missing)}")


class Pose(_Section):
    """Columns of a robot that reports the pose of its tool and the opening of the jaws, but no landmarks."""

    position: Columns
    rotation: Annotated[tuple[str, ...], Field(min_length=3, max_length=9)]
    rotation_kind: Literal["quaternion_xyzw", "quaternion_wxyz", "rotation_vector_rad", "euler_xyz_deg", "matrix"]
    gripper: str = ""
    gripper_unit: Literal["rad", "deg", "mm"] = "rad"

    def model_post_init(self, _: object) -> None:
        n = {"quaternion_xyzw": 4, "quaternion_wxyz": 4, "matrix": 9}.get(self.rotation_kind, 3)
        if len(self.rotation) != n:
            raise ValueError(f"{self.rotation_kind} has {n} columns, rotation names {len(self.rotation)}")


class Frame(_Section):
    """robot_from_log, if the log is in another frame than the robot's: rows of the rotation, and the translation in mm."""

    rotation: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation_mm: Vector = (0.0, 0.0, 0.0)


class Robot(Table):
    """The robot's log: `landmarks` names three columns for each landmark, or `pose` names the columns of the tool's pose."""

    length_unit: Literal["m", "cm", "mm", "um"]
    landmarks: dict[Name, Columns] | None = None
    pose: Pose | None = None
    offset_s: float | Literal["estimate"] = 0.0
    search_s: Annotated[float, Field(gt=0)] = 0.5
    frame: Frame = Frame()

    def model_post_init(self, _: object) -> None:
        if (self.landmarks is None) == (self.pose is None):
            raise ValueError("give the columns of the landmarks or those of the pose, and not both")
        columns = [self.time, *(column for landmark in (self.landmarks or {}).values() for column in landmark)]
        columns += [*self.pose.position, *self.pose.rotation, self.pose.gripper] if self.pose else []
        if twice := next((column for column in columns if columns.count(column) > 1), ""):
            cure = "the time, each axis and each landmark have their own; pivot a table whose rows hold one landmark each"
            raise ValueError(f"the column {twice!r} is named twice; {cure}")


class Hinge(_Section):
    """Jaws that each turn by half the opening about `axis` through `point_mm`; `jaw_mm` leads from there to closed tips."""

    point_mm: Vector
    axis: Vector
    jaw_mm: Vector

    def model_post_init(self, _: object) -> None:
        if not any(self.axis) or not any(self.jaw_mm):
            raise ValueError("axis and jaw_mm are directions, so they cannot be 0: measure them on the tool or its drawing")


class Tool(_Section):
    """Landmarks in the tool frame: given, found from a pivot motion (the landmark rests in a point), hinged, or estimated."""

    landmarks_mm: dict[Name, Vector] = {}
    pivot_s: dict[Name, tuple[float, float]] = {}
    hinge: Hinge | None = None
    turning: dict[Name, Literal[1, -1]] = {"tip_1": 1, "tip_2": -1}
    jaw_length_mm: Annotated[float, Field(gt=0)] | None = None
    estimate: bool = False


class Labels(_Section):
    """Labelled landmarks: one file for both cameras, or one each; `names` maps our landmarks to the file's names."""

    kind: Literal["coco", "cvat", "label_studio", "deeplabcut", "sleap"]
    file: str = ""
    left: str = ""
    right: str = ""
    names: dict[Name, str] = {}
    pixel_origin: Literal["centre", "corner"] = "centre"
    first_frame: int = 0
    sides: tuple[str, str] = ("left", "right")

    def model_post_init(self, _: object) -> None:
        if bool(self.file) == bool(self.left or self.right):
            raise ValueError("give either file, which holds both cameras, or left and right")


class Mapping(_Section):
    """The whole mapping file."""

    name: Text
    description: Text = ""
    landmarks: Annotated[tuple[Name, ...], Field(min_length=2, max_length=8)] = LANDMARKS
    robot_accuracy_mm: Annotated[float, Field(ge=0, lt=1)] = 0.010
    readout_s: Annotated[float, Field(ge=0)] = 0.0
    video: Video
    robot: Robot
    tool: Tool = Tool()
    labels: Labels | None = None

    def model_post_init(self, _: object) -> None:
        ours, columns = set(self.landmarks), self.robot.landmarks
        labels = self.labels.names if self.labels else {}
        if self.labels and (self.video.rotate_left or self.video.rotate_right or self.video.pixel_aspect != 1):
            cure = "leave labels out, and label the recording"
            raise ValueError(f"labels of images that are to be turned are not read, nor if pixel_aspect is not 1: {cure}")
        if len(ours) < len(self.landmarks):
            raise ValueError(f"landmarks {list(self.landmarks)} repeat a name")
        if unknown := sorted({*(columns or {}), *labels, *self.tool.landmarks_mm, *self.tool.pivot_s} - ours):
            raise ValueError(f"landmarks = {list(self.landmarks)} lacks {', '.join(unknown)}, which another table names")
        if missing := sorted(ours - set(columns or ours)):
            raise ValueError(f"robot.landmarks lacks {', '.join(missing)}")


def read_mapping(path: str | Path) -> Mapping:
    """Read and check a mapping file; errors name the file, the key, its value and what is allowed."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; `python3 -m lib import SOURCE --guess --map {path.name}` writes one.")
    try:
        return Mapping.model_validate(read_toml(path))
    except ValidationError as error:
        errors = error.errors(include_url=False, include_context=False)
        first = next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])
        *parts, last = first["loc"] or ("the mapping",)
        parts += [] if last == "float" else [last]  # only offset_s takes a number or a word
        key, text = ".".join(map(str, parts)), repr(first["input"])
        value = f" = {text}" if len(text) < 60 and first["type"] != "missing" else ""
        text = first["msg"].removeprefix("Value error, ").removesuffix(".")
        text = 'a number of seconds is needed, or the word "estimate"' if last == "float" else text
        if first["type"] == "extra_forbidden":
            schema = Mapping.model_json_schema()
            parts = {"the top": schema} | {f"[{name.lower()}]": part for name, part in schema["$defs"].items()}
            homes = [home for home, part in parts.items() if last in part["properties"]]
            near = get_close_matches(str(last), sorted({name for part in parts.values() for name in part["properties"]}), 1)
            text = f"; it belongs to {' or '.join(homes)}" if homes else f"; the nearest one is {near[0]}" if near else ""
            text = f"no such key here{text}"
        raise ValueError(f"{path}: {key}{value}: {text}. data/README.md lists the keys.") from None
