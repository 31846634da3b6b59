"""What the tests of the core share: both array libraries, and worlds that differ in a few values."""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from uav_dc_ros import scenarios
from uav_dc_ros.core.scenario import Scenario, from_values


@pytest.fixture(scope="session", params=["numpy", "torch"])
def array(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Makes an array of one library from anything numpy understands; float64 unless told."""

    def make(values: Any, dtype: Any = None) -> Any:
        plain = np.array(values, dtype=dtype)
        return plain if request.param == "numpy" else torch.from_numpy(plain)

    return make


@pytest.fixture(scope="session")
def three() -> Scenario:
    """The shipped scenario with three clusters."""
    return scenarios.load("three_clusters_hover")


@pytest.fixture(scope="session")
def changed() -> Callable[..., Scenario]:
    """A scenario with other values: `changed(scenario, mission={"max_steps": 5})`, checked as ever."""

    def change(scenario: Scenario, **tables: dict[str, Any]) -> Scenario:
        values = msgspec.to_builtins(scenario)
        for table, entries in tables.items():
            values[table] = values.get(table, {}) | entries
        return from_values(values, "test")

    return change
