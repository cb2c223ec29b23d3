"""The daemon with cameras of the tests' own making: python -m benchmarks.faults.daemon, commands on stdin.

A line is a JSON list, a command and its arguments: ["unplug", 0], ["skip", 0, 5]; end of file stops it as SIGTERM does.
"""

import argparse
import json
import sys
import threading
from dataclasses import replace
from pathlib import Path

from tests.capture.fake_kernel import FakeCamera, RunningKernel, two_cameras

from needletrack.capture.v4l2_abi import Request
from needletrack.config import Config
from needletrack.daemon.run import Daemon, exit_code
from needletrack.errors import NeedletrackError
from needletrack.recording.asl import AslRecording
from needletrack.rig import find_rig
from needletrack.terminal import Interruption

# Little enough that a laptop or a shared machine is not itself the fault.
RATE_HZ = 10.0
_PAIRS = 20
HEARTBEAT_S = 0.1
_TLS_FILES = ("authority", "certificate", "key")


class Cameras(RunningKernel):
    """A recording's pairs from two cameras whose every fault can be commanded from another thread."""

    def __init__(self, recording: AslRecording) -> None:
        width, height = recording.rig.left.size_px
        pairs = [recording.read(index) for index in range(min(_PAIRS, len(recording)))]
        pictures = [(pair.left.image.tobytes(), pair.right.image.tobytes()) for pair in pairs]
        there_and_back = pictures + pictures[-2:0:-1]
        super().__init__(
            two_cameras((width, height), RATE_HZ), lambda number: there_and_back[number % len(there_and_back)], RATE_HZ
        )
        self.blank = bytes(width * height)

    def do(self, command: str, *arguments: int) -> None:
        """Have a fault happen, now."""
        getattr(self, f"_{command}")(*arguments)

    def _camera(self, number: int) -> FakeCamera:
        return next(camera for camera in self.cameras if camera.bus == f"usb-{number + 1}")

    def _skip(self, number: int, count: int) -> None:
        """So many frames that the driver had no buffer for."""
        self._camera(number).sequence += count

    def _flag(self, number: int, count: int) -> None:
        """So many frames with the error flag."""
        camera, real = self._camera(number), FakeCamera.deliver
        left = [count]

        def deliver(stamp_us: int, data: bytes | None = None, **rest: object) -> None:
            left[0] -= 1
            real(camera, stamp_us, data, error=left[0] >= 0)
            if left[0] <= 0:
                del camera.deliver

        camera.deliver = deliver  # type: ignore[method-assign]

    def _refuse(self, number: int, request: int, error: int, count: int) -> None:
        """So many refusals of a request, each with an error."""
        self._camera(number).faults.setdefault(Request(request), []).extend([error] * count)

    def _stall(self, number: int) -> None:
        self._camera(number).deliver = lambda *unused, **rest: None  # type: ignore[method-assign]

    def _resume(self, number: int) -> None:
        del self._camera(number).deliver

    def _unplug(self, number: int) -> None:
        self._camera(number).plugged = False

    def _plug(self, number: int) -> None:
        self._camera(number).plugged = True

    def _swap(self) -> None:
        """The numbers of the nodes change hands."""
        first, second = self.cameras
        first.node, second.node = second.node, first.node


def main() -> int:
    """Run until SIGTERM or the end of stdin; exit codes as of `needletrack run`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument(
        "--name", required=True, help="the rig's, so that no other daemon of this machine is in the way"
    )
    parser.add_argument("--listen", action="append", default=[])
    parser.add_argument("--connect", action="append", default=[])
    parser.add_argument("--tls", type=Path, help="folder of authority, certificate and key")
    parser.add_argument("--record", type=Path)
    parser.add_argument("--idle", action="store_true", help="record on command only")
    parser.add_argument("--control", action="store_true", help="take commands")
    parser.add_argument("--token", type=Path, help="file of the secret that a command bears")
    parser.add_argument("--min-free-mb", type=int, default=0)
    parser.add_argument("--absent", action="store_true", help="no camera is there at the start")
    parser.add_argument("--forbidden", action="store_true", help="the cameras may not be opened")
    parser.add_argument("--other-format", action="store_true", help="the cameras have another format alone")
    asked = parser.parse_args()
    recording = AslRecording(asked.recording, replace(find_rig(asked.recording), name=asked.name))
    kernel = Cameras(recording)
    for camera in kernel.cameras:
        camera.plugged, camera.openable = not asked.absent, not asked.forbidden
        if asked.other_format:
            camera.formats = {"YUYV": camera.formats["GREY"]}
            camera.reset()
    files = {} if asked.tls is None else {what: asked.tls / f"{what}.pem" for what in _TLS_FILES}
    config = Config.model_validate(
        {
            "cameras": {
                "size_px": recording.rig.left.size_px,
                "rate_hz": RATE_HZ,
                "left": {"id": "usb-1"},
                "right": {"id": "usb-2"},
            },
            "publishing": {
                "listen": asked.listen,
                "connect": asked.connect,
                "heartbeat_s": HEARTBEAT_S,
                "tls": files,
            },
            "recording": {
                "folder": asked.record,
                "buffer_mb": 64,
                "min_free_mb": asked.min_free_mb,
                "at_start": not asked.idle,
            },
            "control": {"enabled": asked.control, "token_file": asked.token},
            "daemon": {"metrics_port": 0, "realtime_priority": 0, "lock_memory": False},
        }
    )
    daemon = Daemon(recording.rig, config, kernel=kernel)
    with Interruption() as interruption:

        def listen() -> None:
            for line in sys.stdin:
                command, *arguments = json.loads(line)
                kernel.do(command, *arguments)
            interruption.stop.set()

        threading.Thread(target=listen, daemon=True).start()
        try:
            summary = daemon.run(interruption.stop)
        except NeedletrackError as error:
            print(f"needletrack: {error}", file=sys.stderr)
            return int(exit_code(error))
    print(json.dumps({"recorded": summary.recorded, "unrecorded": summary.unrecorded, "tracked": summary.run.pairs}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
