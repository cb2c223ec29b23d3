#!/usr/bin/env python3
"""Draw a recording of the synthetic world, with its truth: python tools/synthesize.py FOLDER [--help]."""

import argparse
import json
from pathlib import Path
from typing import Any

import cv2

from needletrack.recording.asl import AslRecording
from needletrack.rig import RIG_FILE, Rig, write_rig
from needletrack.synthetic.background import Background
from needletrack.synthetic.needle import NeedleMotion
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.world import DARK_ON_LIGHT, LIGHT_ON_DARK, STEEL, Rod, Truth, World

LIGHTING = {"dark": DARK_ON_LIGHT, "light": LIGHT_ON_DARK, "steel": STEEL}
ROD = Rod((-40.0, 8.0, 215.0), (70.0, -12.0, 215.0))
FIRST_STAMP_S = 1.0


def truth_entry(index: int, truth: Truth, material: str) -> dict[str, Any]:
    """One frame of truth.json, as ../shared/captures/README.md describes it."""
    entry: dict[str, Any] = {"index": index, "t_ns": truth.captured_at_ns}
    if truth.present:
        entry |= {
            "material": material,
            "radius_mm": truth.diameter_mm / 2,
            "tip_kind": truth.tip.value,
            "centerline_mm": truth.centerline_mm.round(6).tolist(),
            "tip_mm": truth.tip_mm.tolist(),
            "tip_direction": truth.tip_direction.tolist(),
            "visible": truth.visible.astype(int).tolist(),
        }
    return entry


def write_recording(folder: Path, world: World, count: int, rate_hz: float, material: str) -> None:
    """Write pairs (EuRoC/ASL layout), rig file and truth.json into a folder that does not exist yet."""
    folder.mkdir(parents=True)
    listings = [["#timestamp [ns],filename"], ["#timestamp [ns],filename"]]
    frames = []
    for pair, truth in world.pairs(rate_hz, count, FIRST_STAMP_S):
        for camera, (frame, listing) in enumerate(zip((pair.left, pair.right), listings, strict=True)):
            path = folder / f"cam{camera}" / "data" / f"{frame.captured_at_ns}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(path), frame.image):
                raise OSError(f"{path}: the image cannot be written")
            listing.append(f"{frame.captured_at_ns},{path.name}")
        frames.append(truth_entry(pair.sequence, truth, material))
    for camera, listing in enumerate(listings):
        (folder / f"cam{camera}" / "data.csv").write_text("\n".join(listing) + "\n")
    write_rig(Rig(world.rig.left, world.rig.right, world.rig.right_from_left, "synthetic"), folder / RIG_FILE)
    document = {"suite": folder.name, "kind": "synthetic", "units": "mm, left camera frame, OpenCV axes"}
    (folder / "truth.json").write_text(json.dumps(document | {"frames": frames}))


def main(arguments: list[str] | None = None) -> None:
    """Write what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=60, help="pairs")
    parser.add_argument("--rate", type=float, default=30.0, help="pairs a second")
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 1024), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--seed", type=int, default=0, help="of needle, background and noise")
    parser.add_argument("--lighting", choices=LIGHTING, default="dark")
    parser.add_argument("--contrast", type=float, default=10.0, help="standard deviation of the texture")
    parser.add_argument("--vessels", type=int, default=0, help="on the plane behind")
    parser.add_argument("--rod", action="store_true", help="a rod in front")
    parser.add_argument("--absent", action="store_true", help="no needle")
    asked = parser.parse_args(arguments)
    world = World(
        default_rig((asked.size[0], asked.size[1])),
        None if asked.absent else NeedleMotion.random(asked.seed),
        Background(contrast=asked.contrast, vessels=asked.vessels),
        LIGHTING[asked.lighting],
        seed=asked.seed,
        rods=(ROD,) if asked.rod else (),
        skew_ns=20_000,
    )
    write_recording(asked.folder, world, asked.count, asked.rate, asked.lighting)
    print(f"{asked.folder}: {len(AslRecording(asked.folder))} pairs")


if __name__ == "__main__":
    main()
