"""TensorBoard scalars. Needs torch, and tensorboard if a folder is given."""

import math
from pathlib import Path

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import FROM_TRAIN, TrainingError
from uav_dc_ros.experiments.train.training import Training


class TensorBoardLog:
    """Writes the curves of every run under `DIR/NAME/seed_S`; writes nothing without a folder."""

    def __init__(self, folder: Path | None, name: str, training: Training) -> None:
        """For the next episodes; raises TrainingError without tensorboard or for an unwritable folder."""
        self._training = training
        self._writers = []
        if folder is None:
            return
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ModuleNotFoundError:
            raise TrainingError(f"--tensorboard: tensorboard {FROM_TRAIN}") from None
        try:
            self._writers = [
                # The purge removes scalars written after the checkpoint that the training resumes from.
                SummaryWriter(str(folder / name / f"seed_{run.seed}"), purge_step=training.n_flown + 1)
                for run in training.population.runs
            ]
        except OSError as error:
            raise TrainingError(f"--tensorboard {folder} cannot be written: {error.strerror}") from None

    def __enter__(self) -> "TensorBoardLog":
        return self

    def __exit__(self, *_: object) -> None:
        for writer in self._writers:
            writer.close()

    def add_episode(self) -> None:
        """Writes the curves of the last episode."""
        if self._writers:
            for name, values in self._training.curves.items():
                self._add(f"training/{name}", values[-1])

    def add_scores(self, scores: Array) -> None:
        """Writes the scores of a validation, `[N]`, and flushes all scalars to the disk."""
        if self._writers:
            self._add("validation/users_brought_home", scores)
        for writer in self._writers:
            writer.flush()

    def _add(self, name: str, values: Array) -> None:
        for writer, value in zip(self._writers, values.tolist(), strict=True):
            if not math.isnan(value):
                writer.add_scalar(name, value, self._training.n_flown)
