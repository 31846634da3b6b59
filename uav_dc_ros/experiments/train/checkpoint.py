"""Checkpoints: the state of a training as one file, which is complete or absent."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from uav_dc_ros import files
from uav_dc_ros.core.keys import leaves
from uav_dc_ros.core.scenario import with_radio_model
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.train.population import Population
from uav_dc_ros.experiments.train.training import Training

_FORMAT = 1
# Every error that reading a damaged or foreign file can raise.
_UNREADABLE = (OSError, SafetensorError, msgspec.DecodeError, KeyError, TypeError, RuntimeError, ValueError)


def save(path: Path, training: Training, progress: Any) -> None:
    """Writes the state between two episodes, and `progress`, which JSON can hold, in place of an older file.

    Raises TrainingError if the file cannot be written.
    """
    arrays, values = training.state()
    write(path, arrays, values | {"population": training.population, "progress": progress})


def restore(path: Path, training: Training) -> dict[str, Any]:
    """Sets a training to the saved state, and returns the `progress` saved with it.

    Raises TrainingError if the file is missing, damaged, or of another population.
    """
    with reading(path) as (arrays, values):
        # Converted, it has the defaults of keys that it was saved without.
        values["population"]["scenario"] = with_radio_model(values["population"]["scenario"])
        saved = dict(leaves(msgspec.to_builtins(msgspec.convert(values["population"], Population))))
        expected = dict(leaves(msgspec.to_builtins(training.population)))
        for key in expected | saved:
            refuse_other(path, key, saved.get(key, "absent"), expected.get(key, "absent"))
        training.restore(arrays, values)
        progress: dict[str, Any] = dict(values["progress"])
    return progress


def write(path: Path, arrays: dict[str, Tensor], values: dict[str, Any]) -> None:
    """Writes arrays, and values that JSON can hold; raises TrainingError if it cannot."""
    try:
        with files.replacing(path) as partial:
            safetensors.torch.save_file(
                {name: array.contiguous().clone() for name, array in arrays.items()},
                partial,
                metadata={"training": msgspec.json.encode(values | {"format": _FORMAT}).decode()},
            )
    except (OSError, SafetensorError) as error:
        raise TrainingError(f"{path} cannot be written: {error}") from None


@contextlib.contextmanager
def reading(path: Path) -> Iterator[tuple[dict[str, Tensor], dict[str, Any]]]:
    """What `write` wrote. Errors in using it become a TrainingError, as those of reading it."""
    try:
        with safe_open(path, framework="pt") as file:
            values = msgspec.json.decode((file.metadata() or {})["training"])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, not a dict
        if values["format"] != _FORMAT:
            raise TrainingError(f"{path}: format is {values['format']}; expected {_FORMAT}")
        yield arrays, values
    except _UNREADABLE as error:
        raise TrainingError(
            f"{path}: cannot be read, or not the state of a training: {error}; delete it to start anew"
        ) from None


def refuse_other(path: Path, key: str, saved: object, expected: object) -> None:
    """Raises TrainingError if a saved value is not that of this command."""
    if saved != expected:
        raise TrainingError(
            f"{path} is the state of a training with {key} = {saved!r}; "
            f"expected {expected!r}, as in this command"
        )
