"""Pages served on this machine alone."""

from __future__ import annotations

import logging
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from mbtf_core.errors import UsageError, reason

HOST = "127.0.0.1"
_LOCAL = (HOST, "localhost")

_log = logging.getLogger(__name__)


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

    Raises
    ------
    UsageError : the port is in use or not allowed
    """

    def __init__(self, html: str, port: int = 0) -> None:
        page = html.encode()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                # Another site that a browser takes for this machine gets nothing.
                local = self.headers.get("Host", "").partition(":")[0].lower() in _LOCAL
                if not local or self.path.partition("?")[0] != "/":
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "text/html; charset=utf-8")
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(page)

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
        self._server.shutdown()
        self._server.server_close()
