"""Recording without tracking: so many pairs, or so long, with a rig or before there is one."""

import threading
from pathlib import Path

import numpy as np
from tests.capture.fake_kernel import RunningKernel, two_cameras
from tests.daemon.test_run import config_for, noise
from tests.recording.small_recording import SIZE_PX, image_of, small_rig
from typer.testing import CliRunner

from needletrack.cli import app
from needletrack.daemon.record import record
from needletrack.recording.mcap_file import McapRecording
from needletrack.records import Clock


def test_so_many_pairs_before_there_is_a_rig(tmp_path: Path) -> None:
    kernel = RunningKernel(two_cameras(SIZE_PX), noise)
    file = tmp_path / "board.mcap"
    done = record(config_for(small_rig()), file, threading.Event(), pairs=40, kernel=kernel)
    assert (done.pairs, done.unrecorded, done.dropped) == (40, 0, {})
    recording = McapRecording(file, without_rig=True)
    assert (len(recording), recording.has_rig, recording.about.clock) == (40, False, Clock.MONOTONIC)
    assert [pair.left.stamp_ns for pair in recording.pairs] == [stamp * 1000 for stamp in kernel.stamps_us[:40]]
    for number in (39, 0):
        assert np.array_equal(recording.read(number).left.image, image_of(number))
    assert done.skew.offset_us == 40


def test_so_long_with_a_rig(tmp_path: Path) -> None:
    kernel, rig = RunningKernel(two_cameras(SIZE_PX), noise), small_rig()
    done = record(config_for(rig), tmp_path / "r.mcap", threading.Event(), rig=rig, seconds=0.3, kernel=kernel)
    assert done.pairs > 3
    assert done.duration_s >= 0.3
    assert McapRecording(tmp_path / "r.mcap").rig.digest == rig.digest


def test_the_command_says_what_is_wrong() -> None:
    result = CliRunner().invoke(app, ["record", "never.mcap"])
    assert result.exit_code == 2
    assert "cameras.left.id is not configured" in result.stderr
    assert not Path("never.mcap").exists()
