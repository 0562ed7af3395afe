"""The build hook: it compiles the kernel where there is a C compiler.

Without a compiler the wheel is pure, and the Python twin of the kernel runs. Hatchling calls `Hook`. The compiler runs
in a process of its own, so that its output does not disturb an installation that does not need it.
"""

import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zlib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PACKAGE = Path(__file__).parent


class Hook(BuildHookInterface[Any]):
    """Adds the compiled kernel to a wheel, or puts it into the checkout for an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the kernel before the wheel is built."""
        self._folder = Path(tempfile.mkdtemp())
        # The stable ABI is CPython's, and free-threaded builds have another one.
        if sys.implementation.name != "cpython" or sysconfig.get_config_var("Py_GIL_DISABLED"):
            return
        command = [sys.executable, str(Path(__file__).resolve()), str(self._folder)]
        done = subprocess.run(command, cwd=self.root, capture_output=True, check=False)
        built = [*self._folder.rglob("_kernel*.so"), *self._folder.rglob("_kernel*.pyd")]
        if done.returncode or not built:
            self.app.display_info("tfbus: no C compiler that works, so the kernel is the one in Python")
            return
        if version == "editable":
            shutil.copy(built[0], PACKAGE)
            return
        build_data["force_include"][str(built[0])] = f"tfbus/{built[0].name}"
        build_data["pure_python"] = False
        build_data["tag"] = f"cp311-abi3-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        """Remove the kernel that was compiled for the wheel."""
        shutil.rmtree(self._folder, ignore_errors=True)


def compile_kernel(folder: Path) -> None:
    """Compile the kernel into a folder."""
    from setuptools import Distribution, Extension  # type: ignore[import-untyped, unused-ignore]

    # The check of `tfbus.running_kernel` in a checkout.
    checksum = 0
    for path in sorted((PACKAGE / "_c_kernel").glob("*.[ch]")):
        checksum = zlib.crc32(path.read_bytes(), checksum)
    flags = ["/O2", "/fp:precise"] if sys.platform == "win32" else ["-O3", "-g0", "-ffp-contract=off"]
    kernel = Extension(
        "tfbus._kernel",
        [str((PACKAGE / "_c_kernel" / "kernel.c").relative_to(Path.cwd()))],
        define_macros=[("KERNEL_SOURCES", str(checksum & 0x7FFF_FFFF))],
        extra_compile_args=flags,
        libraries=[] if sys.platform == "win32" else ["m"],
        py_limited_api=True,
    )
    command = Distribution({"name": "tfbus", "ext_modules": [kernel]}).get_command_obj("build_ext")
    command.build_lib = str(folder)
    command.build_temp = str(folder / "objects")
    command.ensure_finalized()
    command.run()


if __name__ == "__main__":
    compile_kernel(Path(sys.argv[1]))
