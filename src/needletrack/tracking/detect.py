"""The search of both whole images for what may be the needle, without any memory."""

from needletrack.geometry.stereo import StereoRig
from needletrack.tracking.centerline import trace_centerlines
from needletrack.tracking.match import Candidate, match_lines
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.refine import WIDTH_ALLOWANCE, Images
from needletrack.tracking.segment import find_ridges
from needletrack.tracking.stopwatch import Stopwatch


def detect(images: Images, rig: StereoRig, parameters: TrackingParameters, stopwatch: Stopwatch) -> list[Candidate]:
    """Left-right pairs of lines that may be the needle, the best first; raises NeedleNotFound where there is none."""
    needle, z_mm = parameters.needle, parameters.workspace.z_mm
    lines = []
    for image, camera in zip(images, (rig.left, rig.right), strict=True):
        widths_px = (
            needle.min_diameter_mm * camera.focal_px / z_mm.max,
            needle.max_diameter_mm * camera.focal_px / z_mm.min,
        )
        px_per_mm = 2 * camera.focal_px / (z_mm.min + z_mm.max)
        with stopwatch("segment"):
            ridges = find_ridges(image, widths_px, parameters.segment)
        with stopwatch("centerline"):
            lines.append(trace_centerlines(ridges, widths_px[1] * WIDTH_ALLOWANCE, px_per_mm, parameters.centerline))
    with stopwatch("match"):
        return match_lines(lines[0], lines[1], rig, needle, parameters.workspace, parameters.match)
