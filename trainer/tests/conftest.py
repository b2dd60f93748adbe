import pytest
import torch


@pytest.fixture
def one_thread():
    """Several would only wait for each other over networks and batches as small as a test's."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
