import pytest
from support.processes import new_domain
from support.programs import free_address


@pytest.fixture
def address() -> str:
    return free_address()


@pytest.fixture
def domain() -> str:
    return new_domain()
