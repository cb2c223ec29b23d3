"""Pictures of the daemon: for who looks, at most so many a second, on an endpoint of their own."""

import json
import queue
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import zenoh
from tests.capture.fake_kernel import RunningKernel, two_cameras
from tests.daemon.test_run import config_for, free_port, noise, running
from tests.publish.network import WAIT_S, eventually
from tests.recording.small_recording import SIZE_PX, own_rig

from needletrack.daemon.overlay import Overlays
from needletrack.daemon.run import Daemon
from needletrack.errors import PublishError
from needletrack.publish.keys import RigKeys
from needletrack.publish.message import TrackMessage
from needletrack.publish.overlay import OverlayPublisher
from needletrack.publish.schema import example_messages, example_track
from needletrack.publish.session import open_session


def test_pictures_come_to_who_looks_and_the_tracks_session_carries_none() -> None:
    rig, port = own_rig(), free_port()
    overlay = {"rate_hz": 10.0, "listen": [f"tcp/127.0.0.1:{port}"]}
    tracks = f"tcp/127.0.0.1:{free_port()}"
    config = config_for(rig, publishing={"overlay": overlay, "listen": [tracks]})
    key = f"needletrack/{rig.name}/overlay"
    pictures: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    beside: list[zenoh.Sample] = []
    with (
        running(rig, config, RunningKernel(two_cameras(SIZE_PX), noise)) as daemon,
        open_session(connect=overlay["listen"]) as looking,  # type: ignore[arg-type]
        open_session(connect=[tracks]) as elsewhere,
    ):
        daemon.next()
        elsewhere.declare_subscriber(key, beside.append)
        looking.declare_subscriber(key, pictures.put)
        came = [pictures.get(timeout=WAIT_S) for _ in range(5)]
        summary = daemon.stop()
    assert beside == []
    for sample in came:
        drawn = cv2.imdecode(np.frombuffer(sample.payload.to_bytes(), np.uint8), cv2.IMREAD_COLOR)
        assert drawn is not None
        assert drawn.shape == (SIZE_PX[1], 2 * SIZE_PX[0], 3)
        assert str(sample.encoding) == "image/jpeg"
        assert sample.priority == zenoh.Priority.BACKGROUND
        assert sample.congestion_control == zenoh.CongestionControl.DROP
    about = [json.loads(sample.attachment.to_string()) for sample in came if sample.attachment is not None]
    numbers = [one["sequence"] for one in about]
    assert numbers == sorted(set(numbers))
    # 50 pairs a second, 10 pictures: the due times are a grid, though one may be late.
    assert numbers[-1] - numbers[0] >= 10
    assert summary.run.pairs > numbers[-1]


def test_none_are_made_unless_asked_for() -> None:
    rig = own_rig()
    with running(rig, config_for(rig), RunningKernel(two_cameras(SIZE_PX), noise)) as daemon:
        daemon.next()
        assert not any(thread.name == "needletrack-overlay" for thread in threading.enumerate())


def test_a_failure_ends_the_pictures_and_is_told(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    track, pair = example_track()
    with (
        OverlayPublisher(RigKeys("lab"), listen=[endpoint]) as publisher,
        open_session(connect=[endpoint]) as looking,
        Overlays(publisher, own_rig(), 1000.0, 80) as overlays,
    ):
        looking.declare_subscriber("needletrack/lab/overlay", lambda _: None)
        assert eventually(lambda: publisher.has_subscriber)
        publisher.publish = _fail  # type: ignore[method-assign]

        def tried() -> bool:
            overlays.take(pair, track, example_messages()[0])
            return overlays.last_error is not None

        assert eventually(tried)
        overlays.take(pair, track, example_messages()[0])
        assert overlays.last_error == "no overlays any more: the link is gone"
        assert overlays.published == 0
    assert "no overlays any more" in caplog.text


def _fail(jpeg: bytes, of: TrackMessage) -> None:
    raise PublishError("the link is gone")


def test_a_daemon_that_is_open_to_the_network_says_so(caplog: pytest.LogCaptureFixture) -> None:
    rig = own_rig()
    config = config_for(rig, publishing={"listen": [f"tcp/0.0.0.0:{free_port()}"]})
    stop = threading.Event()
    Daemon(rig, config, kernel=RunningKernel(two_cameras(SIZE_PX), noise)).run(stop, ready=stop.set)
    assert "anybody on the network may read and publish at tcp/0.0.0.0" in caplog.text
    assert "set publishing.tls" in caplog.text


def test_taking_never_waits(tmp_path: Path) -> None:
    """Nobody draws here: what is due overwrites what was not drawn."""
    track, pair = example_track()
    with OverlayPublisher(RigKeys("lab"), listen=[f"tcp/127.0.0.1:{free_port()}"]) as publisher:
        overlays = Overlays(publisher, own_rig(), 1000.0, 80)
        began_s = time.monotonic()
        for _ in range(100):
            overlays.take(pair, track, example_messages()[0])
        assert time.monotonic() - began_s < WAIT_S
        assert overlays.published == 0
