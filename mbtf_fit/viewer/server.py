"""Pages served on this machine alone, with messages that they receive while they are open."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from mbtf_core.errors import UsageError, reason

HOST = "127.0.0.1"
_LOCAL = (HOST, "localhost")
# Seconds without a message after which an empty one finds out whether the page is still open.
_SILENCE = 15.0

_log = logging.getLogger(__name__)


class Messages:
    """The latest message of each kind and name, for any number of readers."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._latest: dict[tuple[str, str], tuple[int, str]] = {}
        self._count = 0
        self._closed = False

    def send(self, kind: str, content: Any, name: str = "") -> None:
        """Replace the message of a kind and name; `content` is JSON, without NaN."""
        text = json.dumps({"name": name, "content": content}, separators=(",", ":"), allow_nan=False)
        with self._changed:
            self._count += 1
            self._latest[kind, name] = (self._count, text)
            self._changed.notify_all()

    def close(self) -> None:
        """End all readers."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def read(self) -> Iterator[tuple[str, str] | None]:
        """(kind, text) of all messages, the oldest first, and of new ones as they come; None in silence.
        Older messages that a slow reader has missed are left out."""
        seen = 0
        while True:
            with self._changed:
                if self._count <= seen and not self._closed:
                    self._changed.wait(_SILENCE)
                if self._closed and self._count <= seen:
                    return
                new = sorted((n, kind, text) for (kind, _), (n, text) in self._latest.items() if n > seen)
            if not new:
                yield None
            for number, kind, text in new:
                seen = number
                yield kind, text


class _Server(ThreadingHTTPServer):
    """A thread for each request, which the end of the program ends."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        # Browsers leave in the middle of an answer.
        _log.debug("a request failed: %s", reason(sys.exception()))


class PageServer:
    """Serves one page at a port of this machine until :meth:`close`.

    Parameters
    ----------
    html : the page
    port : 0 for a free one
    messages : sent to the page as server-sent events at the path ``events``

    Raises
    ------
    UsageError : the port is in use or not allowed
    """

    def __init__(self, html: str, port: int = 0, messages: Messages | None = None) -> None:
        page, self._messages = html.encode(), messages

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                # Another site that a browser takes for this machine gets nothing.
                local = self.headers.get("Host", "").partition(":")[0].lower() in _LOCAL
                path = self.path.partition("?")[0]
                if local and path == "/":
                    self._answer("text/html; charset=utf-8")
                    self.wfile.write(page)
                elif local and path == "/events" and messages is not None:
                    self._answer("text/event-stream")
                    self._stream(messages)
                else:
                    self.send_error(404)

            def _answer(self, kind: str) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Cache-Control", "no-store")
                self.end_headers()

            def _stream(self, messages: Messages) -> None:
                for message in messages.read():
                    text = ": \n\n" if message is None else f"event: {message[0]}\ndata: {message[1]}\n\n"
                    self.wfile.write(text.encode())
                    self.wfile.flush()

            def log_message(self, *_: object) -> None:
                """Requests are not logged."""

        try:
            self._server = _Server((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"cannot listen at port {port} ({getattr(error, 'strerror', None) or error})",
                where="--port",
                hint="leave it out for a free port",
            ) from None
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """End the service."""
        if self._messages is not None:
            self._messages.close()
        self._server.shutdown()
        self._server.server_close()
