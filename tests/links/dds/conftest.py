import os
from itertools import count

import pytest

_numbers = count(os.getpid())


@pytest.fixture
def domain_number() -> int:
    """A domain that no other test of this run uses, nor ROS by default."""
    return 100 + next(_numbers) % 100
