"""Pictures for people on the wire: a Zenoh session of their own, so that no picture ever stands before a pose.

Measured: who reads frames of 1.3 MB and poses on one session has its poses 19 ms later (docs/deployment.md).
"""

import json
import threading
import weakref
from collections.abc import Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import zenoh

from needletrack.errors import PublishError
from needletrack.publish.keys import OVERLAY_ENCODING, RigKeys
from needletrack.publish.message import TrackMessage
from needletrack.publish.session import close_soon, direct, open_session
from needletrack.publish.tls import TlsFiles


class OverlayPublisher:
    """Publishes one rig's pictures, at the lowest priority; drops rather than waits.

    Raises PublishError where an endpoint is taken or malformed, or a file of tls cannot be used.
    """

    def __init__(
        self, keys: RigKeys, *, listen: Sequence[str], connect: Sequence[str] = (), tls: TlsFiles | None = None
    ) -> None:
        self.keys = keys
        self._matched = threading.Event()
        with ExitStack() as opened:
            session = opened.enter_context(open_session(listen, connect, tls=tls, rigs=[keys]))
            self._pictures = session.declare_publisher(
                keys.overlay,
                encoding=OVERLAY_ENCODING,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.BACKGROUND,
            )
            self._pictures.declare_matching_listener(direct(self._on_matching))
            # A program that ends without `close` closes the session all the same.
            self._close_session = weakref.finalize(self, close_soon, opened.pop_all())

    @property
    def has_subscriber(self) -> bool:
        """Whether anybody wants pictures now."""
        return self._matched.is_set()

    def publish(self, jpeg: bytes, of: TrackMessage) -> None:
        """Send one picture; its attachment says of which track. Raises PublishError after `close`."""
        about = {"sequence": of.sequence, "captured_at_ns": of.captured_at_ns, "run_id": of.run_id, "status": of.status}
        try:
            self._pictures.put(jpeg, attachment=json.dumps(about))
        except zenoh.ZError as error:
            raise PublishError(f"{self.keys.overlay}: not published: {error}") from error

    def close(self) -> None:
        """Close the session; may be called twice."""
        self._close_session()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _on_matching(self, matching: zenoh.MatchingStatus) -> None:
        if matching.matching:
            self._matched.set()
        else:
            self._matched.clear()
