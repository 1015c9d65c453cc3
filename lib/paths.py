"""Where things lie: the one place that knows the folders of the workbench."""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"
DATA = ROOT / "data"
MODELS = DATA / "models"
GALLERY = DATA / "gallery"
RESULTS = DATA / "results"
CACHE = DATA / "cache"
RUNS = ROOT / "runs"
SHIPPED_RECORDING = DATA / "open_sky_eye"

#: In a folder of results: the recording's place, since recordings of two folders may have one name.
RECORDING_NOTE = "recording.txt"
#: Names the folder in which notebooks of one run, or commands, share what each would else work out again.
SHARED_VARIABLE = "MICROSTEREO_SHARED"


def results_folder(name: str, recording: Path) -> Path:
    """Make the folder runs/NAME for a recording's results; a FileExistsError where it holds another recording's."""
    folder, recording = RUNS / name, recording.resolve()
    note = folder / RECORDING_NOTE
    if note.is_file() and (other := Path(note.read_text(encoding="utf-8").strip())) != recording and other.is_dir():
        raise FileExistsError(f"{shown(folder)}: it has the results of another recording, {other}. Name a folder with --out.")
    folder.mkdir(parents=True, exist_ok=True)
    note.write_text(f"{recording}\n", encoding="utf-8")
    return folder


def shown(path: Path) -> str:
    """A path as a user types it in the workbench's folder: relative to it where it lies inside."""
    path = Path(path).absolute()
    return str(path.relative_to(ROOT) if path.is_relative_to(ROOT) else path)
