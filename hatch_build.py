"""Compiles the kernels of src/needletrack/kernels when the package is built or installed."""

import os
import platform
import shlex
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# Sums may be reordered, so that they vectorise; infinities and NaN keep their meaning, for they have one here.
FLAGS = (
    *("-std=gnu11", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-Wall", "-Wextra"),
    *("-fno-math-errno", "-fno-trapping-math", "-fassociative-math", "-fno-signed-zeros", "-freciprocal-math"),
    "-Werror=incompatible-pointer-types",
)


class KernelBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Leaves the shared libraries beside their sources, and in the wheel, which is then for this platform alone."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; raises SystemExit where there is no compiler."""
        folder = Path(self.root, "src", "needletrack", "kernels")
        sources = sorted(str(path) for path in folder.glob("*.c"))
        targets: dict[str, list[str]] = {"kernels.so": []}
        if platform.machine() in ("x86_64", "AMD64"):
            targets["kernels-v3.so"] = ["-march=x86-64-v3"]
        compiler = shlex.split(os.environ.get("CC", "cc"))
        for name, flags in targets.items():
            command = [*compiler, *FLAGS, *flags, *sources, "-o", str(folder / name), "-lm"]
            try:
                done = subprocess.run(command, capture_output=True, text=True, check=False)
            except FileNotFoundError:
                raise SystemExit(
                    f"needletrack needs a C compiler to be installed, and there is no '{compiler[0]}':"
                    " apt-get install gcc libc6-dev, or name one: CC=/path/to/compiler"
                ) from None
            if done.returncode:
                raise SystemExit(f"the kernels do not compile: {shlex.join(command)}\n{done.stderr}")
        build_data["artifacts"].extend(f"src/needletrack/kernels/{name}" for name in targets)
        build_data["pure_python"] = False
        tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{tag}"
