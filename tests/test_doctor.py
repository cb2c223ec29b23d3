"""The doctor: every line passes on a rig that is well, and names the remedy on one that is not."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from tests.capture.fake_kernel import MONOTONIC, FakeCamera, RunningKernel, two_cameras
from tests.daemon.test_run import config_for, free_port
from tests.recording.small_recording import SIZE_PX, own_rig
from typer.testing import CliRunner

from needletrack import doctor
from needletrack.cli import app
from needletrack.config import Config
from needletrack.daemon.process import OnlyInstance
from needletrack.doctor import Finding, Verdict, examine
from needletrack.errors import CalibrationError
from needletrack.publish.session import open_session
from needletrack.rig import CalibrationInfo, Rig

GRAY = bytes([120]) * (SIZE_PX[0] * SIZE_PX[1])


@pytest.fixture(autouse=True)
def _small_disk_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_DISK_TEST_MB", 8)


def calibrated(days_ago: float = 1) -> Rig:
    info = CalibrationInfo(calibrated_at=datetime.now(UTC) - timedelta(days=days_ago), reprojection_rms_px=0.1)
    return replace(own_rig(), calibration=info)


def examined(
    tmp_path: Path,
    *,
    rig: Rig | None = None,
    fakes: Sequence[FakeCamera] | None = None,
    picture: bytes = GRAY,
    skew_us: int = 40,
    **tables: Any,
) -> dict[str, Finding]:
    """Findings by subject; of several of a subject the worst."""
    known = rig or calibrated()
    usual: dict[str, dict[str, Any]] = {"recording": {"folder": tmp_path}, "cameras": {"exposure_us": 4000.0}}
    config = config_for(known, **{name: {**usual.get(name, {}), **tables.get(name, {})} for name in usual | tables})
    kernel = RunningKernel(fakes or two_cameras(SIZE_PX), lambda number: (picture, picture), skew_us=skew_us)
    found: dict[str, Finding] = {}
    order = [Verdict.PASS, Verdict.WARN, Verdict.FAIL]
    for finding in examine(config, lambda: known, seconds=0.8, kernel=kernel):
        known_worst = found.get(finding.subject)
        if known_worst is None or order.index(finding.verdict) > order.index(known_worst.verdict):
            found[finding.subject] = finding
        assert finding.verdict is Verdict.PASS or finding.remedy, f"no remedy: {finding}"
    return found


def test_a_rig_that_is_well(tmp_path: Path) -> None:
    found = examined(tmp_path)
    for subject in ("rig", "permissions", "cameras", "left camera", "right camera", "pairs", "exposure", "stamps"):
        assert found[subject].verdict is Verdict.PASS, found[subject]
    assert found.keys() >= {"rate", "skew", "disk", "clock", "scheduling", "memory", "zenoh"}
    assert "GREY 64x48, exposure 4000 us" in found["left camera"].seen
    assert "right is 40" in found["skew"].seen
    assert "MB/s" in found["disk"].seen


@pytest.mark.parametrize(
    ("changes", "subject", "verdict", "remedy"),
    [
        ({"rig": own_rig()}, "rig", Verdict.WARN, "calibrate anew"),
        ({"rig": calibrated(90)}, "rig", Verdict.WARN, "calibrate anew"),
        ({"picture": b"\xff" * len(GRAY)}, "exposure", Verdict.WARN, "shorten"),
        ({"picture": b"\x05" * len(GRAY)}, "exposure", Verdict.WARN, "more light"),
        ({"cameras": {"exposure_us": None}}, "left camera", Verdict.WARN, "exposure_us"),
        ({"recording": {"folder": "/no/such/folder"}}, "disk", Verdict.FAIL, "recording.folder"),
        ({"publishing": {"connect": (f"tcp/127.0.0.1:{free_port()}",)}}, "zenoh", Verdict.WARN, "router"),
        ({"skew_us": 900}, "skew", Verdict.WARN, "pairing.offset_us = 900"),
        ({"skew_us": 5000}, "pairs", Verdict.FAIL, "pairing.offset_us = 5000"),
    ],
)
def test_what_is_not_well_is_told_with_the_remedy(
    tmp_path: Path, changes: dict[str, Any], subject: str, verdict: Verdict, remedy: str
) -> None:
    finding = examined(tmp_path, **changes)[subject]
    assert finding.verdict is verdict, finding
    assert remedy in finding.remedy


@pytest.mark.parametrize(
    ("fault", "subject", "told"),
    [
        ({"plugged": False}, "right camera", "usb-2 is not connected"),
        ({"openable": False}, "permissions", "/dev/video1 may not be opened"),
        ({"formats": {"YUYV": [SIZE_PX]}}, "right camera", "does not do GREY"),
        ({"flags": 0}, "stream", "cameras.clock"),
    ],
)
def test_a_camera_that_is_not_well(tmp_path: Path, fault: dict[str, Any], subject: str, told: str) -> None:
    cameras = two_cameras(SIZE_PX)
    for name, value in fault.items():
        setattr(cameras[1], name, value)
        if name == "flags":
            cameras[0].flags = value
    finding = examined(tmp_path, fakes=cameras)[subject]
    assert finding.verdict is Verdict.FAIL
    assert told in finding.seen


def test_a_camera_that_sends_nothing(tmp_path: Path) -> None:
    cameras = two_cameras(SIZE_PX)
    cameras[1].flags = MONOTONIC
    config = config_for(calibrated(), recording={"folder": tmp_path}, cameras={"exposure_us": 4000.0})
    kernel = RunningKernel(cameras, lambda number: None)
    found = list(examine(config, calibrated, seconds=0.3, kernel=kernel))
    assert [finding.verdict for finding in found if finding.subject == "rate"] == [Verdict.FAIL] * 2


def test_a_daemon_that_runs_keeps_its_cameras(tmp_path: Path) -> None:
    with OnlyInstance(own_rig().name):
        found = examined(tmp_path)
    assert found["daemon"].verdict is Verdict.WARN
    assert "left camera" not in found


def test_an_endpoint_that_is_taken(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = open_session([endpoint])
    try:
        finding = examined(tmp_path, publishing={"listen": (endpoint,)})["zenoh"]
    finally:
        session.close()  # type: ignore[no-untyped-call]
    assert finding.verdict is Verdict.FAIL
    assert "is taken" in finding.seen


def test_without_a_rig_the_rest_is_looked_at(tmp_path: Path) -> None:
    def no_rig() -> Rig:
        raise CalibrationError("rig.yaml: cannot read the calibration")

    config = config_for(own_rig(), recording={"folder": tmp_path})
    kernel = RunningKernel(two_cameras(SIZE_PX), lambda number: (GRAY, GRAY))
    found = list(examine(config, no_rig, seconds=0.2, kernel=kernel))
    assert found[0].verdict is Verdict.FAIL
    assert {"left camera", "disk"} <= {finding.subject for finding in found}


def test_more_bits_need_a_faster_disk(tmp_path: Path) -> None:
    def needed(pixels: str) -> float:
        cameras = {"format": pixels, "size_px": (1280, 1024), "left": {"id": "usb-1"}, "right": {"id": "usb-2"}}
        config = Config.model_validate({"cameras": cameras, "recording": {"folder": tmp_path}})
        kernel = RunningKernel(two_cameras(SIZE_PX), lambda number: (GRAY, GRAY))
        found = {each.subject: each for each in examine(config, calibrated, seconds=0.1, kernel=kernel)}
        return float(found["disk"].seen.split("needs about ")[1].split(";")[0])

    assert needed("Y12") == pytest.approx(2 * needed("GREY"), abs=2)


def test_the_command_prints_a_line_each_and_fails_where_something_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NEEDLETRACK_PUBLISHING__LISTEN", f'["tcp/127.0.0.1:{free_port()}"]')
    monkeypatch.setenv("NEEDLETRACK_RECORDING__FOLDER", str(tmp_path))
    result = CliRunner().invoke(app, ["doctor", "--seconds", "0.2"])
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert all(line.startswith(("pass", "warn", "fail")) for line in lines)
    assert "no rig: name one with --rig" in lines[0]
    assert Config().publishing.listen  # the environment, not the defaults, was asked
