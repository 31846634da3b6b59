"""The state of a training on disk: one file, which is there in full or not at all."""

from pathlib import Path
from typing import Any

import msgspec
import safetensors.torch
from safetensors import SafetensorError, safe_open

from uav_dc_ros import files
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.train.population import Population
from uav_dc_ros.experiments.train.training import Training

_FORMAT = 1
# What reading bytes that are no state can end in.
_DAMAGED = (OSError, SafetensorError, msgspec.DecodeError, KeyError, TypeError, RuntimeError, ValueError)


def save(path: Path, training: Training, progress: dict[str, Any]) -> None:
    """Writes the state, under another name first, in place of an older one.

    Args:
        path: the file.
        training: between two episodes.
        progress: what its owner wants back; values that JSON can hold.

    Raises:
        TrainingError: it cannot be written.
    """
    arrays, values = training.state()
    values |= {"format": _FORMAT, "population": _plain(training.population), "progress": progress}
    try:
        with files.replacing(path) as partial:
            safetensors.torch.save_file(
                {name: array.contiguous().clone() for name, array in arrays.items()},
                partial,
                metadata={"training": msgspec.json.encode(values).decode()},
            )
    except (OSError, SafetensorError) as error:
        raise TrainingError(f"{path} cannot be written: {error}") from None


def restore(path: Path, training: Training) -> dict[str, Any]:
    """Takes a training to where `path` was written, and gives back the `progress` written with it.

    Raises:
        TrainingError: no such file, damaged, or of another population.
    """
    try:
        with safe_open(path, framework="pt") as file:
            values = msgspec.json.decode((file.metadata() or {})["training"])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, not a dict
        if values["format"] != _FORMAT:
            raise TrainingError(f"{path}: format is {values['format']}; expected {_FORMAT}")
        _check(values["population"], _plain(training.population), path)
        training.restore(arrays, values)
    except _DAMAGED as error:
        raise TrainingError(
            f"{path}: cannot be read, or not the state of a training: {error}; delete it to start anew"
        ) from None
    return dict(values["progress"])


def _plain(population: Population) -> Any:
    return msgspec.json.decode(msgspec.json.encode(population))


def _check(saved: Any, wanted: Any, path: Path, key: str = "") -> None:
    """Raises TrainingError for the first value in which the two differ."""
    if isinstance(saved, dict) and isinstance(wanted, dict) and saved.keys() == wanted.keys():
        for name in saved:
            _check(saved[name], wanted[name], path, f"{key}.{name}" if key else name)
    elif isinstance(saved, list) and isinstance(wanted, list) and len(saved) == len(wanted):
        for i, (one, other) in enumerate(zip(saved, wanted, strict=True)):
            _check(one, other, path, f"{key}[{i}]")
    elif isinstance(saved, list) and isinstance(wanted, list):
        _check(len(saved), len(wanted), path, f"the number of {key}")
    elif saved != wanted:
        raise TrainingError(
            f"{path} is the state of a training with {key} = {saved!r}; "
            f"expected {wanted!r}, as in this command"
        )
