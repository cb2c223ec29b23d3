"""How likely a needle's silhouette of known width lies at each place across it, whatever its inside looks like.

A cross section of the straightened image is modelled as a Gaussian process: on either side of two edges a background
that wanders slowly, between them an inside that may hold anything (shading, streaks of light, a dark rim), all blurred
by the lens. Integrating over what inside and background are leaves the evidence of where the edges are (Gaussian
process marginal likelihood, Rasmussen & Williams 2006, eq. 2.30): a streak cannot pull the axis, an edge without
contrast leaves it to the other one, and a section without either says so by a flat curve.
"""

from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from needletrack.geometry.spline import cubic_interpolation
from needletrack.kernels import address, call
from needletrack.records import Appearance, Float

Float32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

# Everything here is in units of which the rig's owner's thickest needle has six across: the same matrices then serve
# every rig and depth. Sections reach this far to either side of the predicted axis, at this spacing.
REACH, ACROSS_STEP = 8.0, 0.5
UNITS_PER_MAX_DIAMETER = 6.0
OFFSETS = np.arange(-REACH, REACH + ACROSS_STEP / 2, ACROSS_STEP)
# Fine shifts to each shift.
_FINER = 4


@dataclass(frozen=True, eq=False)
class Grid:
    """The shifts at which the axis is looked for: `substeps` of them to each sample, to either side up to `reach`.

    One covariance serves every shift by whole samples. refine (F, S) interpolates from shifts to
    fine_shifts.
    """

    substeps: int
    reach: int

    @cached_property
    def shifts(self) -> Float:
        """All shifts (S,), evenly spaced."""
        return np.arange(-self.reach, self.reach + 1, dtype=np.float64) * (ACROSS_STEP / self.substeps)

    @cached_property
    def fine_shifts(self) -> Float:
        """Four (F,) to each of them."""
        return np.linspace(self.shifts[0], self.shifts[-1], _FINER * (len(self.shifts) - 1) + 1)

    @cached_property
    def refine(self) -> Float32:
        """Cubic interpolation (F, S)."""
        return cubic_interpolation(len(self.shifts), _FINER).astype(np.float32)


# Where the axis is nearly known; where it is not; where it has to be found and known at one look; where it may be far
# away and is wanted roughly.
NEAR, WIDE, FINE, FAR, _HERE = Grid(4, 12), Grid(2, 14), Grid(4, 28), Grid(1, 13), Grid(1, 0)
# Sigmas of the lens blur, and half widths (a step of 4 %), for which there are matrices.
BLURS = (0.45, 0.55, 0.68, 0.84, 1.05, 1.3)
HALF_WIDTHS = 1.2 * 1.04 ** np.arange(0, 34)

# Standard deviations, in units of a section's noise: of the common level, of a side against it, how much a background
# wanders per root unit (one that is even, one with clutter), and how much the inside wanders and how large it is
# (shaded, streaks, anything).
_LEVEL, _SIDE = 200.0, 20.0
_BACKGROUND_WANDER = (2.0, 12.0)
_KINDS = np.array(_BACKGROUND_WANDER)[:, None, None] ** 2
INSIDES = ((20.0, 60.0), (150.0, 100.0))
DULL, LIVELY = 0, 1
# Two sides that meet, with next to nothing in between, are one edge.
_EDGE_HALF_WIDTH = 1e-3
_LATENT_STEP = 0.25
_LATENT_REACH = REACH + 8.0
_OUTWARDS = np.arange(0.0, _LATENT_REACH - _LATENT_STEP, _LATENT_STEP)


def products(sections: Float) -> Float32:
    """The products (N, F) of every two samples of sections (N, len(OFFSETS)), and 1: what evidence is computed from.

    A misfit is a quadratic form in a section: as one row of a matrix product it costs half of what whitening does, and
    leaves nothing to square and sum. Samples are first whitened as if there were background alone: what misfits have in
    common, which is a thousand times what tells them apart, would else leave single precision nothing. And they are
    split into what is even and what is odd about the middle: one product then serves a shift and its mirror image.
    """
    contiguous = np.ascontiguousarray(sections, dtype=np.float64)
    shown = np.empty((len(contiguous), _FEATURES), np.float32)
    call("products", contiguous, len(contiguous), len(OFFSETS), reference(), shown)
    return shown


def log_evidence(shown: Float32, appearance: Appearance, grid: Grid) -> Float:
    """Log evidence (N, S) of the axis at each shift of the grid, for the `products` of sections of unit noise."""
    return either(log_evidence_by_background(shown, appearance, grid)).astype(np.float64)


def log_evidence_by_background(shown: Float32, appearance: Appearance, grid: Grid) -> Float32:
    """The same (N, 2 S): before a background that is even, and then before one with clutter."""
    each = banks(grid).bank(appearance.inside, appearance.blur, appearance.half_width)
    count, places = len(shown), grid.reach + 1
    log = np.empty((count, 2 * len(grid.shifts)), np.float32)
    work = np.empty(4 * count * _columns_of(places), np.float32)
    call("by_background", shown, count, len(OFFSETS), each, places, places, log, work)
    return log


def log_evidence_of_no_needle(shown: Float32, blur: int) -> Float:
    """Log evidence (N,) of background alone, or of one edge between two, for the `products` of sections of unit noise.

    The edge is that of something wide: of a sleeve, a rod, a vessel beside the curve. It may be anywhere.
    """
    count, log = len(shown), np.empty(len(shown))
    work = np.empty(4 * count * _columns_of(EDGES + 1), np.float32)
    call("no_needle", shown, count, len(OFFSETS), no_needle_bank(BLURS[blur]), EDGES, log, work)
    return log


def either(by_background: Float32) -> Float32:
    """Log evidence (N, S) of one background or the other, from that of each, (N, 2 S)."""
    count, both = by_background.shape
    log = np.empty((count, both // 2), np.float32)
    call("either_of_both", by_background, count, both // 2, log)
    return log


def over_none(by_background: Float32, none: Float) -> tuple[Float, Mask]:
    """Log evidence (N, S) of a needle over that of none (N,), from `log_evidence_by_background`.

    And whether (N,) it is likelier before clutter.
    """
    count, both = by_background.shape
    log, cluttered = np.empty((count, both // 2)), np.empty(count, np.bool_)
    call("over_none", by_background, none, count, both // 2, log, cluttered)
    return log, cluttered


# Products of two of the even samples or of two of the odd ones, and 1; and all of them.
_EVEN = (len(OFFSETS) + 1) // 2
_EVEN_FEATURES = _EVEN * (_EVEN + 1) // 2 + (len(OFFSETS) - _EVEN) * (len(OFFSETS) - _EVEN + 1) // 2 + 1
_FEATURES = len(OFFSETS) * (len(OFFSETS) + 1) // 2 + 1
# Edges are tried at every sample but the outermost two: so many, and their mirror images.
EDGES = _EVEN - 2


@lru_cache(maxsize=1)
def reference() -> Float:
    """What whitens background that wanders least, and leaves even samples, then odd ones (n, n) of a section (n,)."""
    n = len(OFFSETS)
    covariance = _background(OFFSETS[None], BLURS[0])[0, 0] + np.eye(n)
    values, vectors = np.linalg.eigh((covariance + covariance[::-1, ::-1]) / 2)
    white = (vectors / np.sqrt(values)) @ vectors.T
    even = (white + white[::-1])[:_EVEN] / np.sqrt(2)
    even[-1] /= np.sqrt(2)
    return np.ascontiguousarray(np.concatenate([even, (white - white[::-1])[: n - _EVEN] / np.sqrt(2)]))


class Banks:
    """The banks of a grid, each made when it is first wanted, which takes a millisecond, and kept.

    addresses (insides, BLURS, HALF_WIDTHS): where each lies, as the kernels take them; 0 where it was not made.
    """

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._made: dict[tuple[int, int, int], Float32] = {}
        self.addresses = np.zeros((len(INSIDES), len(BLURS), len(HALF_WIDTHS)), np.uintp)

    def bank(self, inside: int, blur: int, half_width: int) -> Float32:
        """The bank of an inside, a blur and a half width, by their indices."""
        key = (inside, blur, half_width)
        if key not in self._made:
            # The first of two threads that make it wins: the other's address may be in use already.
            made = self._made.setdefault(key, new_bank(float(HALF_WIDTHS[half_width]), BLURS[blur], inside, self._grid))
            self.addresses[key] = address(made)
        return self._made[key]


@cache
def banks(grid: Grid) -> Banks:
    """The banks of a grid."""
    return Banks(grid)


def new_bank(half_width: float, blur: float, inside: int, grid: Grid) -> Float32:
    """The hypotheses of one half width at every shift of the grid.

    They are the weights of `products` in the log evidence of each kind and of shifts from 0 on, as `_as_bank` lays
    them out; shifts the other way are the mirror images.
    """
    extra, n = _beyond(grid), len(OFFSETS)
    seen = _covariances(_seen_at_shifts(half_width, blur, grid), inside)
    covariances = np.empty((seen.shape[1], grid.reach + 1, n, n))
    for shift in range(grid.reach + 1):
        whole, rest = divmod(shift, grid.substeps)
        covariances[:, shift] = seen[rest, :, extra - whole : extra - whole + n, extra - whole : extra - whole + n]
    return _as_bank(covariances)


@cache
def no_needle_bank(blur: float) -> Float32:
    """A single edge at every sample from the middle on but the outermost ones, then background alone."""
    edges = _seen(OFFSETS - np.arange(EDGES)[:, None] * ACROSS_STEP, _EDGE_HALF_WIDTH, blur)
    covariances = [_covariances(edges, DULL), _background(OFFSETS[None], blur)]
    return _as_bank(np.concatenate(covariances).swapaxes(0, 1))


@cache
def no_needle_addresses() -> npt.NDArray[np.uintp]:
    """Where the bank of no needle of each of BLURS lies (len(BLURS),), as the kernels take them."""
    return np.array([address(no_needle_bank(blur)) for blur in BLURS], np.uintp)


def _columns_of(places: int) -> int:
    """Columns of a bank of so many places before either kind of background."""
    return -(-places // 8) * 16


def _as_bank(covariances: Float) -> Float32:
    """What kernels multiply by, of covariances (kinds, places, n, n) of what is seen but for noise.

    The weights of `products` in log evidence, in panels of sixteen columns: of even products, then of odd. A panel
    holds eight places before one kind of background and before the other, so that the places in the middle can be asked
    alone.
    """
    contiguous = np.ascontiguousarray(covariances)
    places, n = contiguous.shape[1:3]
    bank = np.empty(_columns_of(places) * _FEATURES, np.float32)
    call("evidence_bank", contiguous, places, n, _unwhitened(), bank)
    return bank


@cache
def _unwhitened() -> Float:
    return np.ascontiguousarray(np.linalg.inv(reference()))


@dataclass(frozen=True, eq=False)
class _Seen:
    """What n samples at each of P places from the axis see of a needle through the lens, but for its inside's look.

    Backgrounds are random walks: sums of steps at places a bin apart, each of which is seen as the blur's integral.
    walks and sides (P, n, n): covariances of those, and of the level of one side against the other. bins (P, n, B): how
    much of each bin of the inside a sample sees; between (B,): where they begin.
    """

    walks: Float
    sides: Float
    bins: Float
    between: Float


def _seen(samples: Float, half_width: float, blur: float) -> _Seen:
    """What samples (P, n) see of a needle so wide."""
    steps = ndtr((np.stack([samples, -samples])[..., None] - half_width - _OUTWARDS) / blur)
    sides = _gram(steps[..., :1]).sum(axis=0)
    walks = _LATENT_STEP * (_gram(steps[..., 1:]).sum(axis=0) + sides / 2)
    borders = np.linspace(-half_width, half_width, max(2, round(2 * half_width / _LATENT_STEP)) + 1)
    bins = -np.diff(ndtr((samples[..., None] - borders) / blur), axis=-1)
    return _Seen(walks, sides, bins, borders[:-1])


def _beyond(grid: Grid) -> int:
    """So many samples more than a section has hold what it sees at every shift by whole samples."""
    return grid.reach // grid.substeps + 1


# One after another, banks of either inside are made of it.
@lru_cache(maxsize=2)
def _seen_at_shifts(half_width: float, blur: float, grid: Grid) -> _Seen:
    longer = np.arange(-_beyond(grid), len(OFFSETS)) * ACROSS_STEP - REACH
    rests = np.arange(grid.substeps)[:, None] * (ACROSS_STEP / grid.substeps)
    return _seen(longer - rests, half_width, blur)


def _covariances(seen: _Seen, inside: int) -> Float:
    """Covariances (P, kinds, n, n) of what is seen of a needle: a kind for each wander of the background."""
    wander, size = INSIDES[inside]
    decay = np.exp(-np.abs(seen.between[:, None] - seen.between) * wander**2 / (2 * size**2))
    common = _LEVEL**2 + _SIDE**2 * seen.sides + size**2 * seen.bins @ decay @ seen.bins.swapaxes(-1, -2)
    return np.asarray(common[:, None] + _KINDS * seen.walks[:, None])


def _background(samples: Float, blur: float) -> Float:
    """Covariances (P, kinds, n, n) of what samples (P, n) see of background alone."""
    steps = ndtr((samples[..., None] - np.arange(0.5 - _LATENT_REACH, _LATENT_REACH, _LATENT_STEP)) / blur)
    return np.asarray(_LEVEL**2 + _KINDS * (_LATENT_STEP * _gram(steps))[:, None])


def _gram(rows: Float) -> Float:
    return rows @ rows.swapaxes(-1, -2)
