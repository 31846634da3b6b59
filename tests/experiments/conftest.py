"""What the tests of training share."""

import pytest
import torch


@pytest.fixture
def one_thread():
    """What training promises to repeat, it promises for one number of threads; torch is left as it was."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
    torch.set_flush_denormal(False)
