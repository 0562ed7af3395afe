import pytest
from support.processes import free_address, new_domain


@pytest.fixture
def address() -> str:
    return free_address()


@pytest.fixture
def domain() -> str:
    return new_domain()
