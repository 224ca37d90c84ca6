"""A page served on this machine alone."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from mbtf_core.errors import UsageError

HOST = "127.0.0.1"
_LOCAL = (HOST, "localhost")


class PageServer:
    """Serves one page at a free port of this machine until :meth:`close`.

    Parameters
    ----------
    html : str
        The page.
    port : int
        0 for a free one.

    Attributes
    ----------
    url : str

    Raises
    ------
    UsageError
        The port is in use or not allowed.
    """

    def __init__(self, html: str, port: int = 0) -> None:
        self.page = html.encode()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                # Another site that a browser takes for this machine gets nothing.
                host = self.headers.get("Host", "").rpartition(":")[0]
                if host not in _LOCAL or self.path.partition("?")[0] != "/":
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "text/html; charset=utf-8")
                self.send_header("Content-Length", str(len(outer.page)))
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(outer.page)

            def log_message(self, *_: object) -> None:
                """Requests are not logged."""

        try:
            self._server = ThreadingHTTPServer((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"cannot listen at port {port} ({getattr(error, 'strerror', None) or error})",
                where="--port",
                hint="leave it out for a free port",
            ) from None
        self._server.daemon_threads = True
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the service."""
        self._server.shutdown()
        self._server.server_close()
