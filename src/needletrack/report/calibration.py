"""The page about a calibration: one HTML file that says at a glance whether to trust it, and shows why."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from needletrack import __version__
from needletrack.calibration.board import Board
from needletrack.calibration.coverage import WANTED_VIEWS
from needletrack.errors import RecordingError
from needletrack.geometry.epipolar import epipolar_distance_px
from needletrack.geometry.uncertainty import parameter_names
from needletrack.recording.board import BoardCalibration, BoardPictures, described
from needletrack.records import Float
from needletrack.report.calibration_figures import (
    LEVELS_MM,
    coverage_figure,
    histogram_figure,
    per_view_figure,
    rectified_figure,
    residual_figure,
    rig_figure,
    thumbnail,
    uncertainty_maps,
)
from needletrack.report.whole import WholeFile

# A shape called ok is right to a millimetre and states 0.4 mm of sigma at most (docs/status.md).
_MOST_BEFORE_MM, _MOST_AFTER_MM = 0.4, 0.1
_MOST_RMS_PX, _MOST_HELD_OUT = 0.3, 1.6
_MOST_LEFT_OUT = 0.4


@dataclass(frozen=True, slots=True)
class Check:
    """One question that decides on trust: whether it is answered well, and in words."""

    good: bool
    text: str
    remedy: str = ""


def checks(found: BoardCalibration) -> tuple[Check, ...]:
    """What a person would look at before trusting a calibration, the gravest first."""
    rms_px, stated, judged = found.solved.rms_px, found.expected, found.held_out
    used, left_out = len(found.solved.used), len(found.left_out)
    # A right corner's distance from a line has the noise of one coordinate of two corners.
    own_px = np.sqrt(2) * found.solved.bundle.sigma_px
    larger = next((each for each in found.improvements if "times as large" in each.change), None)
    tilted = next((each for each in found.improvements if "tilted" in each.change), None)
    cure = "; ".join(
        f"{each.change}: {each.expected.before_mm:.3f} mm" for each in (larger, tilted) if each is not None
    )
    return (
        Check(
            stated.after_mm <= _MOST_AFTER_MM,
            f"Shapes and lengths: {stated.after_mm:.3f} mm rms to expect, after the best rigid alignment "
            f"(wanted: {_MOST_AFTER_MM:g}).",
            f"A larger board or more tilt cures it. {cure}.",
        ),
        Check(
            stated.before_mm <= _MOST_BEFORE_MM,
            f"Places in the left camera's frame: {stated.before_mm:.3f} mm rms to expect "
            f"(wanted: {_MOST_BEFORE_MM:g}).",
            "Focal length and distance are nearly one parameter with so small a board: register the rig to the robot, "
            f"which absorbs it, or take a larger board or more tilt. {cure}.",
        ),
        Check(
            judged.epipolar_px <= _MOST_HELD_OUT * own_px,
            f"Views that were held out lie {judged.epipolar_px:.3f} px rms off their epipolar lines; their own noise "
            f"would be {own_px:.3f}.",
            "The model does not carry over to new views: too few views, a bent board (--warp), or moving cameras.",
        ),
        Check(
            rms_px <= _MOST_RMS_PX,
            f"Corners lie {rms_px:.3f} px rms off (wanted: {_MOST_RMS_PX:g}).",
            "Blur, a bent board, a wrong square, or cameras that moved.",
        ),
        Check(
            used >= WANTED_VIEWS and not found.covered.missing,
            f"{used} views; "
            + (
                "nothing is missing."
                if not found.covered.missing
                else "missing: " + "; ".join(found.covered.missing) + "."
            ),
            "Add these views.",
        ),
        Check(
            left_out <= _MOST_LEFT_OUT * (used + left_out),
            f"{left_out} of {used + left_out} pairs were left out, with the reason.",
            "Look at the reasons below: they have a common cause.",
        ),
    )


def verdict(answers: tuple[Check, ...]) -> tuple[str, str]:
    """Status and sentence: ok, degraded where something is weak, invalid where the figures do not hold."""
    if not (answers[0].good and answers[2].good and answers[3].good):
        return "invalid", "Do not trust this calibration yet."
    if all(answer.good for answer in answers):
        return "ok", "Trust it."
    return "degraded", "Usable, with care: see what is weak."


def write_calibration_report(found: BoardCalibration, pictures: BoardPictures, board: Board, output: Path) -> int:
    """Write the page; the file appears whole or not at all. Returns its size in bytes.

    Raises RecordingError where it cannot be written.
    """
    with WholeFile(output) as page:
        for piece in _pieces(found, pictures, board):
            page.write(piece)
        return page.finish()


@dataclass(frozen=True, slots=True)
class _Rejected:
    name: str
    reason: str
    left: Markup | None
    right: Markup | None


def _pieces(found: BoardCalibration, pictures: BoardPictures, board: Board) -> Iterator[str]:
    environment = Environment(
        loader=PackageLoader("needletrack.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    solved, bundle, rig = found.solved, found.solved.bundle, found.rig
    size_px = pictures.size_px
    answers = checks(found)
    status, sentence = verdict(answers)
    sides = []
    for index, side in enumerate(("left", "right")):
        corners = [px for view in solved.views if (px := (view.left_px, view.right_px)[index]) is not None]
        residuals, times = residual_figure(corners, bundle.residual_px[:, index], size_px, side)
        covered = coverage_figure(corners, found.covered.corners[index], size_px, side)
        sides.append((side, covered, residuals, times))
    off = bundle.residual_px
    numbers = [found.places[place] for place in solved.used]
    middle = _most_spread(solved.view_rms_px)
    yield from environment.get_template("calibration.html").generate(
        title=f"Calibration of {rig.name}",
        status=status,
        sentence=sentence,
        answers=answers,
        tiles=[
            (f"{found.expected.after_mm:.3f} mm", "to expect, aligned"),
            (f"{found.expected.before_mm:.3f} mm", "to expect, left camera's frame"),
            (f"{solved.rms_px:.3f} px", "rms of the corners"),
            (f"{found.held_out.epipolar_px:.3f} px", "off epipolar lines, held out"),
            (f"{found.held_out.length_mm:.4f} mm", f"in lengths up to {found.held_out.longest_mm:g} mm, held out"),
            (str(len(solved.used)), "views used"),
        ],
        facts=_facts(found, pictures, board),
        improvements=found.improvements,
        now=found.expected,
        sides=sides,
        histograms=[
            histogram_figure(
                [("left", "left", off[:, 0, :, axis].ravel()), ("right", "right", off[:, 1, :, axis].ravel())],
                bundle.sigma_px,
                f"residual along {name}, px",
            )
            for axis, name in enumerate(("rows (x)", "columns (y)"))
        ],
        per_view=per_view_figure(solved.view_rms_px, numbers, solved.rms_px),
        rejected=list(_rejected(found, pictures)),
        rectified=rectified_figure(rig, pictures.read(numbers[middle]), solved.views[middle]),
        rectified_number=numbers[middle],
        epipolar=histogram_figure(
            [("all corners of the views used", "right", _epipolar_px(found))],
            float(np.sqrt(2) * bundle.sigma_px),
            "distance from the epipolar line, px",
        ),
        held_out=found.held_out,
        maps=uncertainty_maps(rig, bundle.covariance, found.points_mm),
        levels=[
            (index, text)
            for index, text in enumerate(
                [f"up to {LEVELS_MM[0]:g}", *(f"to {level:g}" for level in LEVELS_MM[1:]), f"above {LEVELS_MM[-1]:g}"]
            )
        ],
        scene=rig_figure(rig, board, bundle.left_from_board, found.points_mm),
        parameters=_parameters(found),
        lenses=[
            (terms, bic - min(b for _, b in solved.lens_bic), terms == solved.terms) for terms, bic in solved.lens_bic
        ],
    )


def _most_spread(view_rms_px: Float) -> int:
    """The view whose rms is the median: neither the best nor the worst is shown."""
    order = np.argsort(view_rms_px.max(axis=1))
    return int(order[len(order) // 2])


def _epipolar_px(found: BoardCalibration) -> Float:
    rig, parts = found.rig, []
    for view in found.solved.views:
        assert view.left_px is not None
        assert view.right_px is not None
        known = np.isfinite(view.left_px + view.right_px).all(axis=1)
        left, right = rig.left.undistort(view.left_px[known]), rig.right.undistort(view.right_px[known])
        parts.append(epipolar_distance_px(rig.fundamental, left, right))
    return np.concatenate(parts)


def _rejected(found: BoardCalibration, pictures: BoardPictures) -> Iterator[_Rejected]:
    unread = set(range(len(pictures.names))) - set(found.places)
    for index in sorted(unread):
        yield _Rejected(pictures.names[index], _why_unread(pictures, index), None, None)
    for each in found.solved.rejected:
        index = found.places[each.index]
        view = found.views[each.index]
        left, right = pictures.read(index)
        yield _Rejected(
            f"view {index}: {pictures.names[index]}",
            each.reason,
            thumbnail(left, view.left_px),
            thumbnail(right, view.right_px),
        )


def _why_unread(pictures: BoardPictures, index: int) -> str:
    try:
        pictures.read(index)
    except RecordingError as error:
        return str(error)
    return "it could be read the second time only"


def _facts(found: BoardCalibration, pictures: BoardPictures, board: Board) -> list[tuple[str, str]]:
    rig, bundle = found.rig, found.solved.bundle
    date = rig.calibration.calibrated_at
    bend = "taken for flat" if bundle.warp_mm is None else " and ".join(f"{mm * 1000:.0f} µm" for mm in bundle.warp_mm)
    return [
        ("Pictures", f"{pictures.source}, {len(pictures.names)} pairs of {pictures.size_px[0]}x{pictures.size_px[1]}"),
        ("Board", f"{described(board)}; bend {bend}"),
        ("Calibrated", "unknown" if date is None else f"{date:%Y-%m-%d %H:%M %Z}"),
        ("Rig", f"digest {rig.digest}, baseline {rig.baseline_mm:.3f} mm"),
        ("Corner noise", f"{bundle.sigma_px:.4f} px a coordinate; {bundle.false_corners} corners left out as false"),
        ("Made", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC by needletrack {__version__}"),
    ]


def _parameters(found: BoardCalibration) -> list[tuple[str, str, str]]:
    """Name, value and sigma of every parameter."""
    rig = found.rig
    values: list[float] = []
    for camera in (rig.left, rig.right):
        values += [*camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), *camera.distortion.tolist()]
    values += [0.0, 0.0, 0.0, *rig.right_from_left.translation_mm.tolist()]
    sigmas = np.sqrt(np.diag(found.solved.bundle.covariance)).tolist()
    rows = []
    for name, value, sigma in zip(parameter_names(rig), values, sigmas, strict=True):
        if name.startswith("turn"):
            rows.append((name, "–", f"{np.degrees(sigma):.4f}°"))
        elif name.startswith("shift"):
            rows.append((name, f"{value:.3f} mm", f"{sigma:.4f} mm"))
        elif name.split(".")[1] in ("fx", "fy", "cx", "cy"):
            rows.append((name, f"{value:.2f} px", f"{sigma:.2f} px"))
        else:
            rows.append((name, f"{value:.5f}", f"{sigma:.5f}"))
    return rows
