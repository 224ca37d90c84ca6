"""The viewer's page and its commands."""

from __future__ import annotations

import http.client
import json
from pathlib import Path

import pytest
from support.pages import loads
from support.plugin_materials import net, write_material

from mbtf_core.app.console import run
from mbtf_core.errors import UsageError
from mbtf_fit.cli.app import app
from mbtf_fit.viewer.page import safe_json, write_page
from mbtf_fit.viewer.server import PageServer


def test_a_page_loads_nothing_and_has_the_same_bytes_again(tmp_path: Path) -> None:
    write_material(tmp_path / "material", model="relief")
    words = ["export", str(tmp_path / "material"), "--to", "web", "-q", "-o"]
    for name in ("a", "b", "b"):
        assert run(app, [*words, str(tmp_path / name)]) == 0
    html = (tmp_path / "a" / "viewer.html").read_text()
    assert html == (tmp_path / "b" / "viewer.html").read_text()
    assert loads(html).external == []
    assert "default-src 'none'" in html
    assert "connect-src 'none'" in html


def test_text_cannot_end_the_script() -> None:
    text = safe_json({"name": "</script><!-- & \u2028 é"})
    assert not set(text) & set("<>&\u2028é")
    assert json.loads(text) == {"name": "</script><!-- & \u2028 é"}
    assert "<b>" not in write_page({"materials": []}, "<b>bold</b>")


def test_what_cannot_be_shown_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_material(tmp_path / "patches", model="hierarchical")
    write_material(tmp_path / "good")
    write_material(tmp_path / "mlp", model="hierarchical", **net(decoder="mlp"))
    out = ["-o", str(tmp_path / "page")]
    for words, code, what in (
        (["export", str(tmp_path / "patches"), "--to", "web", *out], 3, "operation 'neighborhood'"),
        (["view", str(tmp_path / "nothing")], 3, "no such"),
        (["export", str(tmp_path / "good"), "--shape", "x.obj", *out], 2, "--shape: is an option of web"),
        (["export", str(tmp_path / "good"), "--to", "web", "--against", "x", *out], 3, "x"),
        (["view", str(tmp_path / "good"), "--port", "99999"], 2, "--port: cannot listen at port 99999"),
    ):
        assert run(app, words) == code, words
        error = capsys.readouterr().err
        assert what in error
        assert "Traceback" not in error
    assert run(app, ["export", str(tmp_path / "mlp"), "--to", "web", *out, "-q"]) == 0


def test_only_this_machine_gets_the_page() -> None:
    server = PageServer("<p>page</p>")
    try:
        host, port = "127.0.0.1", int(server.url.rstrip("/").rpartition(":")[2])

        def get(path: str, name: str) -> tuple[int, bytes]:
            connection = http.client.HTTPConnection(host, port, timeout=10)
            connection.request("GET", path, headers={"Host": name})
            answer = connection.getresponse()
            return answer.status, answer.read()

        assert get("/", f"{host}:{port}") == (200, b"<p>page</p>")
        assert get("/?x", f"localhost:{port}")[0] == 200
        assert get("/etc/passwd", f"{host}:{port}")[0] == 404
        assert get("/", f"elsewhere.example:{port}")[0] == 404
        with pytest.raises(UsageError, match="cannot listen"):
            PageServer("", port)
    finally:
        server.close()
