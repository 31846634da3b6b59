"""What every training begins with: its options, torch on a device, and the folder of its checkpoints."""

import argparse
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from uav_dc_ros.agents import policy
from uav_dc_ros.errors import FROM_TRAIN, TrainingError

if TYPE_CHECKING:
    import torch


def option_error(error: msgspec.ValidationError, options: argparse.Namespace) -> TrainingError:
    """The error of a policy's config that `options` do not fit, with the option and its value."""
    # Such as: Expected `float` <= 1.0 - at `$.hyperparameters.gamma`
    expected, _, path = str(error).replace("`", "").replace("Expected", "expected").partition(" - at $.")
    key = path.split(".")[-1].split("[")[0]
    if key == "name":
        return TrainingError(
            f"--out {options.out}: {options.out.name!r} is no name of a policy; "
            f"expected {policy.NAME_IN_WORDS}"
        )
    return TrainingError(f"--{key.replace('_', '-')} is {getattr(options, key)!r}; {expected}")


def torch_device(name: str, n_threads: int) -> "torch.device":
    """The device to compute on; raises TrainingError without torch or the device."""
    try:
        import torch
    except ModuleNotFoundError:
        raise TrainingError(f"torch {FROM_TRAIN}") from None
    from uav_dc_ros.experiments.train.training import prepare_torch

    prepare_torch(n_threads)
    if name.partition(":")[0] not in ("cpu", "cuda"):
        raise TrainingError(f"--device is {name!r}; expected cpu, cuda or cuda:N")
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise TrainingError(f"--device is {name!r}; {str(error).splitlines()[0]}") from None
    return torch.device(name)


def make_folder(folder: Path, resume: bool, prefix: str, n_done: int) -> None:
    """Make the folder of the checkpoints, or take an existing one to resume.

    Removes policies, `prefix` and six digits, that a killed training saved after its last checkpoint.
    """
    if not resume:
        policy.check_new(folder)
    try:
        folder.mkdir(parents=True, exist_ok=resume)
    except OSError as error:
        raise TrainingError(f"{folder} cannot be made: {error.strerror}") from None
    for best in folder.glob(prefix + 6 * "[0-9]"):
        if int(best.name.removeprefix(prefix)) > n_done:
            shutil.rmtree(best)
