"""The parameters of networks for sets as torch tensors, with optimisers. Needs torch."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional
from torch.optim import Optimizer

from uav_dc_ros.agents import set_network
from uav_dc_ros.agents.network import Parameters
from uav_dc_ros.agents.set_network import SetArchitecture
from uav_dc_ros.core.arrays import Array

GRADIENT_MAX = 10.0  # norm
FALL = 0.02  # share of a learning rate at the end


class SetLearner:
    """Base of learners: parameters, and an optimiser for each group of them, by the first part of a name."""

    def __init__(
        self, architecture: SetArchitecture, parameters: Parameters, groups: Sequence[str] = ("",)
    ) -> None:
        self.architecture = architecture
        self.theta = {name: torch.from_numpy(v.copy()).requires_grad_() for name, v in parameters.items()}
        self._groups = {group: self._of(group) for group in groups}
        self._optimisers: dict[str, Optimizer] = {
            group: torch.optim.Adam(tensors, lr=0.0, eps=1e-5, fused=True)
            for group, tensors in self._groups.items()
        }

    def _of(self, group: str) -> list[Tensor]:
        return [tensor for name, tensor in self.theta.items() if group in ("", name.partition(".")[0])]

    def set_rate(self, learning_rate: float, group: str = "") -> None:
        """Set the learning rate of a group of parameters."""
        self._optimisers[group].param_groups[0]["lr"] = learning_rate

    def descend(self, loss: Tensor, group: str = "") -> None:
        """A step of a group of parameters against the gradient of a loss."""
        optimiser = self._optimisers[group]
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self._groups[group], GRADIENT_MAX)
        optimiser.step()

    def preferences(self, observation: Array) -> Array:
        """See `set_network.preferences`; `[B, D]` to `[B, A]`, float32."""
        with torch.inference_mode():
            rows = torch.from_numpy(observation)
            found: Array = set_network.preferences(self.architecture, self.theta, rows, active).numpy()
            return found

    def parameters(self) -> Parameters:
        """A copy of the parameters, numpy, as `set_network.shapes` names them."""
        return {name: values.detach().numpy().copy() for name, values in self.theta.items()}

    def state(self) -> dict[str, Tensor]:
        """Everything that later updates depend on."""
        state = {f"theta.{name}": values.detach() for name, values in self.theta.items()}
        for group, optimiser in self._optimisers.items():
            for i, moments in optimiser.state_dict()["state"].items():
                state |= {f"adam{group}.{i}.{key}": values for key, values in moments.items()}
        return state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the `state` of a learner of the same architecture."""
        moments: dict[str, dict[int, dict[str, Tensor]]] = {group: {} for group in self._groups}
        with torch.no_grad():
            for name, values in state.items():
                kind, _, key = name.partition(".")
                if kind == "theta":
                    self.theta[key].copy_(values)
                else:
                    index, _, key = key.partition(".")
                    moments[kind.removeprefix("adam")].setdefault(int(index), {})[key] = values
        for group, optimiser in self._optimisers.items():
            optimiser.load_state_dict(optimiser.state_dict() | {"state": moments[group]})


def active(values: Tensor) -> Tensor:
    """As `set_network.activation`, fused."""
    return functional.relu(functional.layer_norm(values, values.shape[-1:]))
