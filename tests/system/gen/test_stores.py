"""An S3 server: runs, damages, fits, connections that are cut, writers that are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.commands import Done
from support.object_stores import BUCKET, Proxy, downloaded, s3_server
from support.small_runs import command, contents, generate, noisy_plane, write_maps

from mbtf_core.data.store import ObjectStore
from mbtf_core.data.verify import verify
from mbtf_gen.planning.simulation import ClosedForm

URL = f"s3://{BUCKET}/some/data"
# A program with values that need no renderer. Before the writes of an object that it is told, it ends as by a
# kill, or it waits.
_CODE = """
import os, signal, sys, time
from mbtf_core.data.store import ObjectStore
from mbtf_core.app.console import run
from mbtf_gen.planning.simulation import ClosedForm
from support.small_runs import noisy_plane
ClosedForm.estimate = noisy_plane
program, at, *line = sys.argv[1:]
write = ObjectStore.write
def stopped(self, name, content, *, new=False):
    if name == at:
        os.kill(os.getpid(), signal.SIGKILL)
    return write(self, name, content, new=new)
ObjectStore.write = stopped
if program == "mbtf-gen":
    from mbtf_gen.cli.app import app
else:
    from mbtf_fit.cli.app import app
sys.exit(run(app, line))
"""


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[Proxy]:
    with s3_server(tmp_path / "cache") as found:
        yield found


def call(*line: object, program: str = "mbtf-gen", kill_at: str = "") -> Done:
    words = [sys.executable, "-c", _CODE, program, kill_at, *map(str, line)]
    paths = os.pathsep.join(filter(None, [*sys.path]))
    variables = {**os.environ, "PYTHONPATH": paths}
    child = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False, env=variables)
    return Done(child.returncode, child.stdout, child.stderr)


def line_at(folder: Path, *more: str, train: int = 100) -> list[str]:
    line = command(folder, Path("OUT"), train=train)
    return [URL if word == "OUT" else word for word in line] + list(more)


def generated(folder: Path, *, train: int = 100) -> dict[str, Any]:
    """Contents of an undisturbed local run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ClosedForm, "estimate", noisy_plane)
        assert generate(command(folder, folder / "local", train=train)) == 0
    return contents(folder / "local")


def stored(folder: Path) -> dict[str, Any]:
    """Contents of the store."""
    return contents(downloaded(URL, folder))


def test_a_data_set_from_generation_to_fit(tmp_path: Path, proxy: Proxy) -> None:
    expected = generated(tmp_path)
    assert call(*line_at(tmp_path)).code == 0
    assert stored(tmp_path / "copy") == expected
    assert call("merge", URL).code == 0
    # A second machine has an empty cache.
    os.environ["XDG_CACHE_HOME"] += "-2"
    ObjectStore(URL).write("train-00001.npz", b"damaged")
    assert call("verify", URL).code == 3
    assert call("repair", URL).code == 0
    assert stored(tmp_path / "repaired") == expected
    steps = ["--steps", "5", "--set", "training.batch=30"]
    for shards, out in ((URL, "theirs"), (tmp_path / "local", "mine")):
        done = call(shards, *steps, "-o", tmp_path / out, program="mbtf-fit")
        assert done.code == 0, done.err
    weights = [(tmp_path / out / "weights.safetensors").read_bytes() for out in ("mine", "theirs")]
    assert weights[0] == weights[1]


def test_connections_that_are_cut(tmp_path: Path, proxy: Proxy) -> None:
    """Uploads and downloads end in the middle, again and again."""
    expected = generated(tmp_path)
    proxy.cut_after, proxy.cuts = 3000, 8
    done = call(*line_at(tmp_path))
    assert done.code == 0, done.err
    assert proxy.done >= 4
    proxy.cut_after = None
    assert stored(tmp_path / "copy") == expected
    proxy.cut_after, proxy.cuts, proxy.answers = 3000, 5, True
    steps = ["--steps", "5", "--set", "training.batch=30"]
    for program, line in (
        ("mbtf-gen", ["verify", URL]),
        ("mbtf-fit", [URL, *steps, "-o", tmp_path / "theirs"]),
        ("mbtf-fit", [tmp_path / "local", *steps, "-o", tmp_path / "mine"]),
    ):
        proxy.done = 0
        done = call(*line, program=program)
        assert done.code == 0, done.err
        assert proxy.done == (0 if tmp_path / "local" in line else 5)
    weights = [(tmp_path / out / "weights.safetensors").read_bytes() for out in ("mine", "theirs")]
    assert weights[0] == weights[1]


def test_a_store_that_is_gone(tmp_path: Path, proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line, exit code 4, and the same command resumes; nothing is rendered twice."""
    expected = generated(tmp_path, train=400)
    monkeypatch.setenv("MBTF_STORE_PATIENCE", "4")
    words = [sys.executable, "-c", _CODE, "mbtf-gen", "", *line_at(tmp_path, train=400)]
    paths = os.pathsep.join(filter(None, sys.path))
    running = subprocess.Popen(
        words, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths}
    )
    watched = ObjectStore(URL)
    while not any(name.endswith(".json") and name[0] == "t" for name in watched.list()):
        assert running.poll() is None
        time.sleep(0.01)
    proxy.down = True
    err = running.communicate(timeout=300)[1]
    assert running.returncode == 4, err
    # The material has a warning.
    _, fault, hint = err.splitlines()
    assert fault.startswith(f"error: {URL}/")
    assert "the store cannot be reached" in fault
    assert "run the same command again" in hint
    waiting = list((tmp_path / "cache/mbtf/stores/waiting").glob("*/*.npz"))
    assert waiting
    proxy.down = False
    done = call(*line_at(tmp_path, train=400), "--json")
    assert done.code == 0, done.err
    assert stored(tmp_path / "copy") == expected
    found = done.result()
    # Rendered by the second run: neither what was stored nor what waited.
    uploaded = [name for name in expected if name.endswith(".npz")]
    paths = sum(expected[name.replace(".npz", ".json")]["paths"] for name in uploaded)
    assert found["paths"] < paths
    assert not list((tmp_path / "cache/mbtf/stores/waiting").glob("*/*"))


@pytest.mark.parametrize("at", ["geometry.exr", "train-00001.json"])
def test_a_writer_that_is_killed(tmp_path: Path, proxy: Proxy, at: str) -> None:
    """Also between a shard and its sidecar; then another machine goes on, or the same one."""
    expected = generated(tmp_path)
    assert call(*line_at(tmp_path), kill_at=at).code == -signal.SIGKILL
    names = set(ObjectStore(URL).list())
    assert at not in names
    assert ("train-00001.npz" in names) == (at == "train-00001.json")
    assert call(*line_at(tmp_path)).code == 0
    assert stored(tmp_path / "copy") == expected
    assert verify(URL) == []


def test_workers_upload_their_shards(tmp_path: Path, proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the store, the shards fail by name; the same command goes on."""
    pytest.importorskip("distributed", reason="no Dask; to enable: pip install 'mbtf[cluster]'")
    write_maps(tmp_path)
    line = f"{tmp_path}/maps --queries 16/texel --test-queries 200 --test-spp 8 -q".split()
    line += ["--set", "output.shard_queries=512", "-o"]
    assert call(*line, tmp_path / "local").code == 0
    monkeypatch.setenv("MBTF_STORE_PATIENCE", "3")
    assert call(*line, URL, "--slice", "1/5").code == 0
    # Workers can list the store, but not upload to it.
    proxy.cut_after = 20_000
    done = call(*line, URL, "--cluster", "local:2")
    assert done.code == 4, done.err
    assert "shard(s) failed" in done.err
    # Whether the connection or the time ends first.
    assert "the store cannot be reached" in done.err or "no answer" in done.err
    proxy.cut_after = None
    monkeypatch.delenv("MBTF_STORE_PATIENCE")
    done = call(*line, URL, "--cluster", "local:2")
    assert done.code == 0, done.err
    assert stored(tmp_path / "copy") == contents(tmp_path / "local")
