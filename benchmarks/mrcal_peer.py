"""mrcal on corners that are given, for a Python that has mrcal (Debian: python3-mrcal): JSON on stdin and on stdout.

Needs nothing of needletrack, so that it can run in another environment.
"""

import json
import sys
import time

import mrcal
import numpy as np


def main() -> None:
    """Calibrate."""
    given = json.load(sys.stdin)
    corners = np.array(given["corners_px"], dtype=float)  # views, cameras, rows, columns, 2
    views, cameras = corners.shape[:2]
    weight = np.where(np.isfinite(corners).all(axis=-1), 1.0, -1.0)
    observations = np.concatenate([np.nan_to_num(corners), weight[..., None]], axis=-1)
    indices = np.array(
        [(view, camera, camera - 1) for view in range(views) for camera in range(cameras)], dtype=np.int32
    )
    lens = f"LENSMODEL_OPENCV{given['terms']}"
    inputs = {
        "intrinsics": np.array(given["intrinsics"], dtype=float),
        "extrinsics_rt_fromref": np.array(given["right_from_left_rt"], dtype=float).reshape(1, 6),
        "frames_rt_toref": np.array(given["left_from_board_rt"], dtype=float),
        "points": None,
        "observations_board": np.ascontiguousarray(observations.reshape(-1, *observations.shape[2:])),
        "indices_frame_camintrinsics_camextrinsics": indices,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": lens,
        "imagersizes": np.array([given["size_px"]] * 2, dtype=np.int32),
        "calibration_object_spacing": given["square_m"],
        "calobject_warp": np.zeros(2),
        "do_optimize_calobject_warp": True,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": True,
        "do_apply_outlier_rejection": True,
        "do_apply_regularization": True,
        "verbose": False,
    }
    began = time.perf_counter()
    stats = mrcal.optimize(**inputs)
    seconds = time.perf_counter() - began
    models = [mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=camera) for camera in range(cameras)]
    points = np.array(given["points_m"], dtype=float)
    pose = inputs["extrinsics_rt_fromref"][0]
    left_px = mrcal.project(points, *models[0].intrinsics())
    right_px = mrcal.project(mrcal.transform_point_rt(pose, points), *models[1].intrinsics())
    rms_mm = []
    for stabilized in (False, True):
        total = 0.0
        for one, two in zip(left_px, right_px, strict=True):
            # -1: the corners' noise as the residuals have it.
            _, of_calibration, *_ = mrcal.triangulate(
                np.stack([one, two]),
                models,
                q_calibration_stdev=-1,
                q_observation_stdev=0,
                stabilize_coords=stabilized,
            )
            total += float(np.trace(of_calibration))
        rms_mm.append(1000 * float(np.sqrt(total / len(points))))
    json.dump(
        {
            "rms_px": float(stats["rms_reproj_error__pixels"]),
            "seconds": seconds,
            "intrinsics": inputs["intrinsics"].tolist(),
            "right_from_left_rt": pose.tolist(),
            "outliers": int((inputs["observations_board"][..., 2] < 0).sum() - (weight < 0).sum()),
            "rms_mm": rms_mm,
        },
        sys.stdout,
    )


if __name__ == "__main__":
    main()
