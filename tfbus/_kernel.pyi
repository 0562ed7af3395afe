"""The compiled kernel for type checkers: the twins have the types of their definitions in Python, the rest has none."""

from typing import Any

from tfbus._python_kernel import Chain as Chain
from tfbus._python_kernel import Edge as Edge
from tfbus._python_kernel import History as History
from tfbus._python_kernel import Judge as Judge
from tfbus._python_kernel import Line as Line
from tfbus._python_kernel import Parked as Parked
from tfbus._python_kernel import Paths as Paths
from tfbus._python_kernel import Sample as Sample
from tfbus._python_kernel import columns as columns
from tfbus._python_kernel import commit as commit
from tfbus._python_kernel import compose_paths as compose_paths
from tfbus._python_kernel import compose_rows as compose_rows
from tfbus._python_kernel import decode as decode
from tfbus._python_kernel import decode_whole as decode_whole
from tfbus._python_kernel import fill_matrix as fill_matrix
from tfbus._python_kernel import invert_row as invert_row
from tfbus._python_kernel import move_point as move_point
from tfbus._python_kernel import move_points as move_points
from tfbus._python_kernel import row_of_matrix as row_of_matrix

Feed: Any
Intake: Any
Method: Any
sources: int
