"""The pictures of one track, as files."""

from pathlib import Path

from needletrack.geometry.stereo import StereoRig
from needletrack.pictures.distance_map import distance_map_figure
from needletrack.pictures.overlay import overlay_figure
from needletrack.pictures.png import write_png
from needletrack.pictures.shape import shape_figure
from needletrack.records import NeedleTrack, StereoPair


def write_pictures(track: NeedleTrack, pair: StereoPair, rig: StereoRig, folder: Path | str, stem: str) -> list[Path]:
    """Write <stem>-overlay.png, <stem>-distance-map.png and <stem>-shape.png, with or without a shape.

    Makes the folder where there is none. Raises NeedletrackError where a file cannot be written.
    """
    folder = Path(folder)
    figures = {
        "overlay": overlay_figure(track, pair, rig),
        "distance-map": distance_map_figure(track, rig),
        "shape": shape_figure(track),
    }
    return [write_png(figure, folder / f"{stem}-{name}.png") for name, figure in figures.items()]
