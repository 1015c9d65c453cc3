"""Weights on disk: safetensors files with JSON metadata and a checksum of both."""

import json
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as safetensors_bytes
from torch import Tensor, uint8

from lib import files
from lib.landmarks.network import HourglassConfig, Network, OffsetConfig, network_of

_CURE = "get the file again, or train one with `python3 -m lib train`."


def checksum(tensors: dict[str, Tensor], metadata: dict[str, str]) -> str:
    """SHA-256 (hexadecimal) of the tensors' names, types, shapes and bytes, and of the metadata except ``"sha256"``."""
    parts = []
    for name, tensor in sorted(tensors.items()):
        parts.append(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        parts.append(tensor.detach().cpu().contiguous().reshape(-1).view(uint8).numpy().data)
    parts += [f"{name} {value}\n".encode() for name, value in sorted(metadata.items()) if name != "sha256"]
    return files.digest(*parts, length=64)


def write_checkpoint(path: str | Path, tensors: dict[str, Tensor], metadata: dict[str, object]) -> None:
    """Write tensors, JSON metadata and their checksum as a safetensors file; if that fails, the old file is unchanged.

    >>> import tempfile, torch
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_checkpoint(f"{folder}/a.safetensors", {"x": torch.ones(2)}, {"format": "mine"})
    ...     read_checkpoint(f"{folder}/a.safetensors", "mine")[0]
    {'x': tensor([1., 1.])}
    """
    tensors = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    texts = {name: json.dumps(value) for name, value in metadata.items()}
    texts["sha256"] = json.dumps(checksum(tensors, texts))
    try:
        files.write_bytes(path, safetensors_bytes(tensors, metadata=texts))
    except OSError as error:
        raise OSError(f"{path}: not saved ({error.strerror or error}); an earlier file there is unharmed") from error


def read_checkpoint(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Tensors and metadata of a file that `write_checkpoint` wrote with ``metadata["format"] == kind``.

    Raises FileNotFoundError if there is no file, and ValueError if it is damaged, has no checksum or another format.
    """
    if Path(path).is_dir():
        raise IsADirectoryError(f"{path}: it is a folder; give the .safetensors file in it.")
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such weights file; train one with `python3 -m lib train`.")
    try:
        with safe_open(path, framework="pt") as file:
            texts = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        metadata = {name: json.loads(value) for name, value in texts.items()}
    except (SafetensorError, ValueError, OSError) as error:
        raise ValueError(f"{path}: corrupt, or not a weights file of this program ({error}); {_CURE}") from error
    if "format" in metadata and metadata.pop("sha256", None) != checksum(tensors, texts):  # of whatever kind
        raise ValueError(f"{path}: damaged, its SHA-256 checksum is missing or does not fit its content; {_CURE}")
    if metadata.get("format") != kind:
        raise ValueError(f"{path}: holds {metadata.get('format', 'foreign weights')!r}, expected {kind!r}; {_CURE}")
    return tensors, metadata


def with_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin with `prefix`, without it in their names."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def load_network(path: str | Path, config: dict, tensors: dict[str, Tensor], prefix: str = "") -> Network:
    """Make the network of a configuration, with the tensors whose names begin with `prefix`; error messages name `path`."""
    try:
        network = network_of((OffsetConfig if "size_px" in config else HourglassConfig)(**config))
        network.load_state_dict(with_prefix(tensors, prefix))
    except (TypeError, RuntimeError, ValueError) as error:
        text = str(error).splitlines()[0]
        raise ValueError(f"{path}: its weights do not fit its configuration ({text}); {_CURE}") from error
    return network
