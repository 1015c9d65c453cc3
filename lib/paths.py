"""The folders of the workbench; all other modules take them from here."""

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

#: File in a folder of results with the recording's path, since recordings in different folders may have the same name.
RECORDING_NOTE = "recording.txt"
#: Environment variable with the folder in which the notebooks of a run, or commands, share results to save time.
SHARED_VARIABLE = "MICROSTEREO_SHARED"


def results_folder(name: str, recording: Path) -> Path:
    """Make the folder runs/NAME for a recording's results; a FileExistsError if it has those of another recording."""
    folder, recording = RUNS / name, recording.resolve()
    note = folder / RECORDING_NOTE
    if note.is_file() and (other := Path(note.read_text(encoding="utf-8").strip())) != recording and other.is_dir():
        raise FileExistsError(f"{shown(folder)}: it has the results of another recording, {other}. Name a folder with --out.")
    folder.mkdir(parents=True, exist_ok=True)
    note.write_text(f"{recording}\n", encoding="utf-8")
    return folder


def shown(path: Path) -> str:
    """A path as a user types it in the workbench's folder: relative to it if it is inside."""
    path = Path(path).absolute()
    return str(path.relative_to(ROOT) if path.is_relative_to(ROOT) else path)
