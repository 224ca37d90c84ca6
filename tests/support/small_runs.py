"""Whole runs of ``mbtf-gen`` in milliseconds: a plane, whose values need no renderer, with noise on them."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mbtf_core.app.console import run
from mbtf_core.data.schema import Queries
from mbtf_gen.cli.app import app
from mbtf_gen.planning.simulation import ClosedForm
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.rng import Purpose, numpy_generator


def noisy_plane(
    self: ClosedForm, queries: Queries, spp: int, stream: Stream, *, lights: int = 1
) -> Estimates:
    """In place of :meth:`ClosedForm.estimate`: values that no two shards share."""
    rng = numpy_generator(stream.root, stream.split, stream.shard, Purpose.FOOTPRINT)
    a, b = ((self.value * rng.random((len(queries.sigma), 3))).astype(np.float32) for _ in range(2))
    return Estimates(a, b, None, len(a) * spp, 0, 0, 0)


def command(folder: Path, output: Path, *, train: int = 100) -> list[str]:
    """Command line of a small run; makes its material, `folder`/plane.npy, where it is missing."""
    material = folder / "plane.npy"
    if not material.exists():
        np.save(material, np.full((4, 8), 0.5))
    sizes = f"--queries {train} --test-queries 30 --set output.shard_queries=40"
    return [str(material), *sizes.split(), "-o", str(output), "-q"]


def in_child(act: Callable[[], object]) -> int:
    """Process number of a fork of this process that does something and ends."""
    child = os.fork()
    if child:
        return child
    code = 70
    try:
        code = int(act() or 0)  # type: ignore[call-overload]
    finally:
        os._exit(code)


def ending(child: int) -> int:
    """Exit code of a child, or the negative number of the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def die(*_: object) -> None:
    """Ends this process as a kill does."""
    os.kill(os.getpid(), signal.SIGKILL)
    signal.pause()


def generate(line: list[str]) -> int:
    """Run a command line in this process; its exit code."""
    return run(app, line)


def contents(folder: Path) -> dict[str, Any]:
    """Everything in a folder that must come out the same: bytes of shards and of the configuration, documents
    without their times and checksums. No file is left out."""
    found: dict[str, Any] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix == ".json" and not path.name.startswith("."):
            document = json.loads(path.read_text())
            document.pop("checksum")
            document.pop("seconds", None)
            if document.get("summary"):
                document["summary"].pop("shard_seconds")
            found[path.name] = document
        else:
            found[path.name] = path.read_bytes()
    return found


def write_maps(folder: Path, shape: tuple[int, int] = (8, 16)) -> None:
    """Heights and colors without any symmetry, in folder/maps."""
    maps = folder / "maps"
    maps.mkdir()
    rng = np.random.default_rng(4)
    np.save(maps / "height.npy", (0.1 * rng.random(shape)).astype(np.float32))
    Image.fromarray(rng.integers(0, 255, (*shape, 3)).astype(np.uint8)).save(maps / "base_color.png")
