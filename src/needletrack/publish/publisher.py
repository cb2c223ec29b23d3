"""The daemon's side of the wire: one Zenoh peer that publishes tracks, heartbeats and its liveliness."""

import threading
import time
import weakref
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import zenoh

from needletrack.errors import PublishError
from needletrack.publish.clock import CLOCK_ENCODING, ClockMessage
from needletrack.publish.keys import DEFAULT_ENDPOINT, DEFAULT_PREFIX, STATUS_ENCODING, TRACK_ENCODING, RigKeys
from needletrack.publish.message import RunContext, StatusMessage, TrackMessage
from needletrack.publish.session import close_soon, direct, open_session
from needletrack.publish.tls import TlsFiles

DEFAULT_HEARTBEAT_S = 0.5

# On a link of half the rate that 50 Hz need, poses grew older without end, as long as the kernel buffered for
# them (5.1 s old after 10 s, and none lost); with this, 1.4 s old at most, and every other one lost and counted.
SEND_BUFFER_BYTES = 65536


class ZenohPublisher:
    """Publishes one rig's tracks; waits for no subscriber, and at most 1 ms for one whose link is full.

    status is called once a heartbeat, from this object's own thread, and once more on closing. control: takes the
    queries below `control/`, in Zenoh's thread; None answers none. tls: whoever connects then shows a certificate, and
    may do what its role may. Raises PublishError where an endpoint is taken or malformed, or a file of tls cannot be
    used. An error of `status` is raised by the next `publish` or by `close`.
    """

    def __init__(
        self,
        run: RunContext,
        status: Callable[[], StatusMessage],
        *,
        listen: Sequence[str] = (DEFAULT_ENDPOINT,),
        connect: Sequence[str] = (),
        key_prefix: str = DEFAULT_PREFIX,
        heartbeat_s: float = DEFAULT_HEARTBEAT_S,
        control: Callable[[zenoh.Query], None] | None = None,
        tls: TlsFiles | None = None,
    ) -> None:
        self.keys = RigKeys(run.rig, key_prefix)
        self._status = status
        self._heartbeat_s = heartbeat_s
        self._status_json = status().to_json()
        self._matched = threading.Event()
        self._stop = threading.Event()
        self._failure: Exception | None = None
        with ExitStack() as opened:
            session = opened.enter_context(
                open_session(listen, connect, tls=tls, rigs=[self.keys], send_buffer_bytes=SEND_BUFFER_BYTES)
            )
            self._declare(session)
            if control is not None:
                session.declare_queryable(self.keys.control("*"), direct(control))
            # Last, and so first to go: whoever sees the token can query, and gets the last heartbeat.
            opened.enter_context(session.liveliness().declare_token(self.keys.alive))
            # A program that ends without `close` closes the session all the same.
            self._close_session = weakref.finalize(self, close_soon, opened.pop_all())
        self._heart = threading.Thread(target=self._beat, name="needletrack-heartbeat", daemon=True)
        self._heart.start()

    def _declare(self, session: zenoh.Session) -> None:
        # Drop: a pose that waits in a queue is worth less than the next one. Its own priority: a slow
        # reader of anything else on this session cannot hold it up. Express: not batched with others.
        self._tracks = session.declare_publisher(
            self.keys.track,
            encoding=TRACK_ENCODING,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        self._tracks.declare_matching_listener(direct(self._on_matching))
        self._heartbeats = session.declare_publisher(
            self.keys.status,
            encoding=STATUS_ENCODING,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW,
        )
        session.declare_queryable(self.keys.status, direct(self._on_status_query), complete=True)
        session.declare_queryable(self.keys.clock, direct(self._on_clock_query), complete=True)

    def publish(self, message: TrackMessage) -> None:
        """Send one track; it is dropped where nobody listens or a link is full.

        Raises PublishError after `close`, and what `status` raised in the heartbeat's thread.
        """
        self._raise_failure()
        try:
            self._tracks.put(message.to_json())
        except zenoh.ZError as error:
            raise PublishError(f"{self.keys.track}: not published: {error}") from error

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Whether a subscriber of the track was there within the time."""
        return self._matched.wait(timeout_s)

    @property
    def has_subscriber(self) -> bool:
        """Whether anybody listens to the track now."""
        return self._matched.is_set()

    def close(self) -> None:
        """Send the last heartbeat, take the liveliness token back, close the session; may be called twice."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._heart.join()
        try:
            if self._failure is None:
                self._send_status()
        finally:
            self._close_session()
        self._raise_failure()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _beat(self) -> None:
        try:
            while not self._stop.wait(self._heartbeat_s):
                self._send_status()
        except Exception as error:  # handed to the thread that publishes
            self._failure = error

    def _send_status(self) -> None:
        self._status_json = self._status().to_json()
        self._heartbeats.put(self._status_json)

    def _on_status_query(self, query: zenoh.Query) -> None:
        with query:
            query.reply(self.keys.status, self._status_json, encoding=STATUS_ENCODING)

    def _on_clock_query(self, query: zenoh.Query) -> None:
        received_at_ns = time.time_ns()
        with query:
            # Only who asks for it by name: somebody who looks at all keys wants no time.
            if str(query.key_expr) == self.keys.clock:
                answer = ClockMessage.now(received_at_ns, time.time_ns())
                query.reply(self.keys.clock, answer.to_json(), encoding=CLOCK_ENCODING)

    def _on_matching(self, matching: zenoh.MatchingStatus) -> None:
        if matching.matching:
            self._matched.set()
        else:
            self._matched.clear()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure
