"""icpReconstructor on lines found by others: JSON in, JSON out, in an environment of its own (`make peers`).

benchmarks/accuracy/peers.py starts this file. It imports nothing of needletrack, and needletrack nothing of it: the
package is under the GPL and is only run here. Parameters are those of its own examples where nothing else is said.
https://github.com/MKHoffmann/icpReconstructor
"""

import contextlib
import io
import json
import re
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

warnings.simplefilter("ignore")

from icpReconstructor.casadi_reconstruction import (  # type: ignore[import-not-found] # noqa: E402
    CasadiCurveEstimator,
    CasadiMovingFrame,
    Polynomial3Casadi,
)
from icpReconstructor.epipolar_reconstruction import EpipolarReconstructor  # type: ignore[import-not-found] # noqa: E402
from icpReconstructor.utils import PixelDataset  # type: ignore[import-not-found] # noqa: E402

# Its examples take every 20th pixel (5 mm here). That serves to start the second stage, where arc lengths summed over
# closer points come out too long; alone, the first stage is better with closer ones.
CLOSE_PX, EXAMPLE_PX = 5, 20
# One needle is one segment (three did worse), and a bend of 10 mm radius has a curvature of 100 per metre.
SEGMENTS, STEPS, GREATEST_CURVATURE = 1, 40, 100
# Where its solver succeeds it needs far fewer; without a limit, a frame on which it does not takes minutes.
MOST_ITERATIONS = 500


def main() -> None:
    """Answer every frame of the job on standard input."""
    job = json.load(sys.stdin)
    answers = []
    with tempfile.TemporaryDirectory() as scratch:
        for frame in job["frames"]:
            method = Method(job["cameras"], frame, Path(scratch))
            # Its solver prints, and standard output is ours.
            with contextlib.redirect_stdout(io.StringIO()):
                answers.append(method.answer())
    json.dump(answers, sys.stdout)


class Method:
    """Both stages on one frame."""

    def __init__(self, cameras: list[dict[str, Any]], frame: dict[str, Any], scratch: Path) -> None:
        self.pose = np.array(frame["world_from_left_m"])
        rotation, translation = self.pose[:3, :3], self.pose[:3, 3]
        self.cameras = [
            {name: np.array(camera[name], float) for name in ("A", "dist", "P")}
            | {"R_cam0_world": rotation, "T_cam0_world": translation}
            for camera in cameras
        ]
        self.lines = [np.array(line, np.float32) for line in frame["undistorted_px"]]
        self.regions = [np.array(region, float) for region in frame["region_px"]]
        self.length_m = frame["length_m"]
        # Where a line begins is read from a MATLAB file.
        self.starts = [str(scratch / f"start{side}.mat") for side in range(2)]
        for path, line in zip(self.starts, self.lines, strict=True):
            savemat(path, {"p_start": line[:1].astype(float)})

    def answer(self) -> dict[str, Any]:
        """Points, time and failure of the first stage alone, and of both."""
        first = self._timed(lambda: self.epipolar(CLOSE_PX)[:, :3])
        both = first if self.length_m is None else self._timed(lambda: self.icp(self.epipolar(EXAMPLE_PX)))
        return {"epipolar": first, "epipolar + ICP": both}

    def epipolar(self, interval_px: int) -> Any:
        """Points and arc length (N, 4) in the world's frame, m."""
        blank = np.zeros((1, 1), np.uint8)  # the images serve its pictures only
        arguments = [camera[name] for name in ("A", "dist", "P") for camera in self.cameras]
        where = self.pose[:3, :3], self.pose[:3, 3]
        method = EpipolarReconstructor(blank, blank, *arguments, *where, 200, *self.starts)
        return method.get_3D(data_cam_0=self.lines[0], data_cam_1=self.lines[1], interval=interval_px, plot=False)

    def icp(self, points: Any) -> Any:
        """Backbone (N, 3) in the world's frame, m, fitted to the points, then to the pixels of both images."""
        ends_m = self.length_m * np.arange(1, SEGMENTS + 1) / SEGMENTS
        model = CasadiMovingFrame(ends_m, n_steps=STEPS)
        model.ux, model.uy = (Polynomial3Casadi(model.opt, SEGMENTS) for _ in range(2))
        for axis in ("x", "y"):
            model.add_u_constraint(axis, -GREATEST_CURVATURE, GREATEST_CURVATURE)
        model.opt.solver("ipopt", {"print_time": False}, {"print_level": 0, "max_iter": MOST_ITERATIONS})
        estimator = CasadiCurveEstimator(model, self.cameras, ends_m[-1], dist_norm=2)
        points = points[points[:, 3] <= self.length_m]
        estimator.solve_3d(points[:, 3], points[:, :3].T, lam_2=0)
        data = PixelDataset(self.regions, use_numpy=True)
        half = np.random.default_rng(0).permutation(len(data))[: max(len(data) // 2, 1)]
        estimator._set_warmstart_ipopt(1e-6, max_iter=MOST_ITERATIONS)  # noqa: SLF001 - as its examples do
        estimator.icp_step(data.p[half], data.img_idx_data[half])
        return estimator.sol.value(model.get_p()).T

    def _timed(self, stage: Any) -> dict[str, Any]:
        started = time.perf_counter()
        points_mm, failed = None, None
        try:
            points_mm = ((stage() - self.pose[:3, 3]) @ self.pose[:3, :3] * 1e3).tolist()
            if len(points_mm) < 2 or not np.isfinite(points_mm).all():
                points_mm, failed = None, "no two finite points"
        # Whatever it raises is its answer to this frame, and is counted.
        except Exception as error:
            failed = _in_short(error)
        return {"points_mm": points_mm, "ms": (time.perf_counter() - started) * 1e3, "failure": failed}


def _in_short(error: Exception) -> str:
    solver = re.search(r"return_status is '(\w+)'", str(error))
    if solver is not None:
        return f"Ipopt: {solver[1]}"
    return " ".join([type(error).__name__ + ":", *str(error).split()])[:80]


if __name__ == "__main__":
    main()
