"""An S3 server on the loopback interface, and a proxy before it that cuts connections."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from mbtf_core.data.store import ObjectStore

BUCKET = "bucket"


class Proxy:
    """Forwards TCP connections to a server on this machine.

    Attributes
    ----------
    port : where it listens
    down : refuse every connection, and cut those that exist
    cut_after : bytes after which each connection is cut; None for never
    answers : count the bytes of the server, not those of the client
    cuts : connections to cut; without a limit if None
    """

    def __init__(self, server: int) -> None:
        self.down = False
        self.cut_after: int | None = None
        self.answers = False
        self.cuts: int | None = None
        self.done = 0
        self._server = server
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        if self.down:
            client.close()
            return
        server = socket.create_connection(("127.0.0.1", self._server))
        pair = (client, server)
        threading.Thread(target=self._forward, args=(server, client, pair, True), daemon=True).start()
        self._forward(client, server, pair, False)

    def _forward(
        self, source: socket.socket, sink: socket.socket, pair: tuple[socket.socket, ...], answer: bool
    ) -> None:
        passed = 0
        with contextlib.suppress(OSError):
            while data := source.recv(4096):
                passed += len(data)
                if self.down or (answer == self.answers and self._cuts(passed)):
                    break
                sink.sendall(data)
        for end in pair:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _cuts(self, passed: int) -> bool:
        if self.cut_after is None or passed <= self.cut_after or self.cuts == self.done:
            return False
        self.done += 1
        return True


@contextlib.contextmanager
def silent_server() -> Iterator[int]:
    """Port of a server on the loopback interface that accepts connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        accepted: list[socket.socket] = []

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    accepted.append(listener.accept()[0])

        threading.Thread(target=accept, daemon=True).start()
        try:
            yield int(listener.getsockname()[1])
        finally:
            for connection in accepted:
                connection.close()


@contextlib.contextmanager
def s3_server(folder: Path) -> Iterator[Proxy]:
    """An empty bucket behind a proxy. This process and its children find it, and have a cache of their own in
    `folder`."""
    server = pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    # The server's objects outlive it in this process.
    urllib.request.urlopen(urllib.request.Request(f"http://{host}:{port}/moto-api/reset", method="POST"))
    proxy = Proxy(port)
    variables = {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{proxy.port}",
        "AWS_CONFIG_FILE": os.devnull,
        "AWS_MAX_ATTEMPTS": "1",
        "XDG_CACHE_HOME": str(folder),
        "MBTF_STORE_PATIENCE": "30",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        # fsspec keeps one client per set of arguments, and the endpoint is none of them.
        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem(use_listings_cache=False).mkdir(BUCKET)
        try:
            yield proxy
        finally:
            proxy.down = False
            s3fs.S3FileSystem.clear_instance_cache()
            running.stop()
            proxy.close()


@contextlib.contextmanager
def memory_store(folder: Path) -> Iterator[str]:
    """URL of an empty store in this process, with a cache in `folder`."""
    fsspec = pytest.importorskip("fsspec")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.setenv("MBTF_STORE_PATIENCE", "0")
        files = fsspec.filesystem("memory", use_listings_cache=False)
        files.store.clear()
        files.pseudo_dirs[:] = [""]
        try:
            yield "memory://data/x"
        finally:
            files.store.clear()


def downloaded(url: str, folder: Path) -> Path:
    """A new local copy of everything in a store."""
    store = ObjectStore(url)
    folder.mkdir()
    for name in store.list():
        (folder / name).write_bytes(store.read(name))
    return folder
