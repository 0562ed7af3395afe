import pytest
from support.processes import new_dds_domain


@pytest.fixture
def domain_number() -> int:
    return new_dds_domain()
