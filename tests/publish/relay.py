"""A TCP link of the tests' own between two ends on this machine: it delays, throttles, holds, cuts, and heals.

The kernel's netem would do the same and more; here it is not there, and needs root elsewhere.
"""

import asyncio
import socket
import threading
from collections.abc import Coroutine
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

_CHUNK = 16 * 1024
# Little is on the way inside the relay, so that what is late is so by the link's own fault.
_BUFFER = 32 * 1024
_A_MOMENT_S = 0.02


class Relay:
    """Listens on `port` and passes bytes to and from 127.0.0.1:`to`, in a thread of its own.

    delay_s: each way, for every chunk, in order. bytes_per_s: each way; None: as fast as it goes. Both may be set
    at any time.
    """

    def __init__(self, to: int) -> None:
        self._to = to
        self.delay_s = 0.0
        self.bytes_per_s: float | None = None
        self._loop = asyncio.new_event_loop()
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._links: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        self.heal()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A connection that was being taken as the link was cut is there a moment later, and so is the end of one.
        for _ in range(2):
            self.cut()
            self._do(asyncio.sleep(_A_MOMENT_S))
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def cut(self) -> None:
        """Close every connection, and refuse new ones."""
        self._do(self._cut())

    def heal(self) -> None:
        """Take connections again."""
        self._do(self._listen())

    def hold(self) -> None:
        """Pass nothing on, and close nothing: a cable that was pulled."""
        self._loop.call_soon_threadsafe(self._flowing.clear)

    def release(self) -> None:
        """Pass on again what was held."""
        self._loop.call_soon_threadsafe(self._flowing.set)

    def _do(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result(10.0)

    async def _listen(self) -> None:
        if self._server is None:
            listening = _socket()
            listening.bind(("127.0.0.1", self.port))
            self._server = await asyncio.start_server(self._accept, sock=listening, limit=_BUFFER)

    async def _cut(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None
        links = list(self._links)
        for link in links:
            link.cancel()
        await asyncio.gather(*links, return_exceptions=True)

    async def _accept(self, near: asyncio.StreamReader, to_near: asyncio.StreamWriter) -> None:
        link = asyncio.current_task()
        assert link is not None
        if self._server is None:
            to_near.transport.abort()
            return
        self._links.add(link)
        try:
            with suppress(OSError):
                outward = _socket()
                try:
                    await self._loop.sock_connect(outward, ("127.0.0.1", self._to))
                except OSError:
                    outward.close()
                    raise
                far, to_far = await asyncio.open_connection(sock=outward, limit=_BUFFER)
                for writer in (to_near, to_far):
                    writer.transport.set_write_buffer_limits(_BUFFER)
                ways = [asyncio.create_task(way) for way in (self._pass(near, to_far), self._pass(far, to_near))]
                try:
                    await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    for way in ways:
                        way.cancel()
                    await asyncio.gather(*ways, return_exceptions=True)
                    to_far.transport.abort()
        except asyncio.CancelledError:
            pass  # cut
        finally:
            to_near.transport.abort()
            self._links.discard(link)

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        late: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(maxsize=1024)

        async def deliver() -> None:
            while True:
                due_s, chunk = await late.get()
                await asyncio.sleep(due_s - self._loop.time())
                await self._flowing.wait()
                writer.write(chunk)
                await writer.drain()

        delivering = asyncio.create_task(deliver())
        try:
            with suppress(OSError):
                while chunk := await reader.read(_CHUNK):
                    if self.bytes_per_s is not None:
                        await asyncio.sleep(len(chunk) / self.bytes_per_s)
                    await late.put((self._loop.time() + self.delay_s, chunk))
        finally:
            delivering.cancel()
            await asyncio.gather(delivering, return_exceptions=True)


def _socket() -> socket.socket:
    made = socket.socket()
    made.setblocking(False)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    # Left alone, the kernel would take megabytes off the sender's hands here, which no cable does.
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    return made
