"""The viewer's page of materials: size, time to the first picture, time and operations of a frame.

    python benchmarks/viewer.py [MATERIAL ...] [--size 1280x720] [--frames 3]

Without a material it makes random ones of 256 × 256 texels: ``relief`` and ``neumip`` of the presets' sizes,
and ``neumip`` of the paper's. Each page is opened in a headless Chromium that draws by the processor
(SwiftShader). A frame shows the plane with one light, 3 tiles across from 50°, no environment.

**Operations** are counted per pixel: multiplications and additions of the networks, texel fetches, and nodes
of the height field that the view rays visit (measured in the page). The estimate for an integrated graphics
card assumes that it sustains so many operations and fetches per second (``--arithmetic``, ``--fetches``;
by default a fifth of the nominal rates of an Intel Iris Xe: 2 · 10¹² operations, 1.5 · 10¹⁰ fetches of four
floats), and that both overlap.

The last line is one JSON object. Thresholds: a page of 256 × 256 texels has at most 5 MB, the first picture
takes at most 2 s, and the estimate is at least 30 frames per second.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import finish, parser_of, start
from numpy.typing import NDArray

from mbtf_core.data.geometry import Geometry
from mbtf_core.data.lattice import Lattice
from mbtf_core.images.resample import resample
from mbtf_fit.config import FitConfig, best_options, build_model
from mbtf_fit.material.material import Material, export
from mbtf_fit.ops.constants import PLACES
from mbtf_fit.surface.known import KnownSurface
from mbtf_fit.viewer.page import material_content, write_page

F32 = NDArray[np.float32]
SIZE, SECONDS, FRAMES_PER_SECOND = 5.0, 2.0, 30.0
_TRAINING = {"steps": 0, "batch": 1, "seconds": 0.0, "device": "cpu", "threads": 1, "errors": {}}
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


def smooth(shape: tuple[int, int, int], random: np.random.Generator) -> F32:
    """A random map with details of 1/16 of its side, as maps have."""
    coarse = random.random((16, 16, shape[2]))
    return np.asarray(resample(coarse, shape[0], shape[1]), np.float32)


def random_material(folder: Path, model: str, paper: bool) -> Path:
    """A material of 256 × 256 texels with smooth random textures."""
    random, lattice = np.random.default_rng(0), Lattice(8, 1.0)
    network: dict[str, Any] = {}
    if not paper:
        for key, value in best_options(30.0, model).items():
            section = network
            *path, last = key.split(".")[1:]
            if key.startswith("network."):
                for name in path:
                    section = section.setdefault(name, {})
                section[last] = value
    config = FitConfig.model_validate({"model": model, "network": network})
    built = build_model(config.model, lattice, **config.network.model_dump())
    built.initialize(torch.Generator().manual_seed(0), 0.2)
    if built.tracing is not None:
        heights = np.float32(-0.12) * smooth((256, 256, 1), random)[..., 0]
        maps = smooth((512, 512, 6), random)
        moments = np.stack([maps[..., 0] ** 2, maps[..., 0] * maps[..., 1], maps[..., 1] ** 2], -1)
        geometry = Geometry(
            heights, 1.0, maps[..., :2], moments, maps[..., 2:5], maps[..., 5], maps[..., 2], None, None
        )
        built.know(KnownSurface.of(geometry, lattice, 1.0))
    tensors = built.weights()
    for name, tensor in tensors.items():
        if name.startswith(("pyramid.", "offset_texture.")):
            tensors[name] = torch.from_numpy(
                smooth((tensor.shape[0], tensor.shape[1], tensor.shape[2]), random)
            )
    built.load_weights(tensors)
    out = folder / f"{model}{'-paper' if paper else ''}"
    out.mkdir()
    export(built, config, out, data={}, training=_TRAINING)
    return out


def operations(material: Material, visited: float) -> dict[str, float]:
    """Operations and texel fetches per pixel with one light."""
    weights, network = material.model.weights(), material.config.network
    layers = [w for name, w in weights.items() if w.ndim == 2 and name.endswith(".weight")]
    padded = sum(-(-w.shape[0] // 4) * 4 * (-(-w.shape[1] // 4) * 4) for w in layers)
    channels = -(-weights["pyramid.0"].shape[2] // 4)
    lookups = 2 * channels + (
        0 if network.offset == "none" else -(-weights["offset_texture.0"].shape[2] // 4)
    )
    if "surface.light_width" in weights:
        # Maps have two layers, horizons one; two levels each.
        lookups += 6 * len(PLACES[network.relief.places][0])
    fetches = 4 * lookups + visited + (8 if "calibration" in weights else 0)
    # Three interpolations of four numbers, three operations each; about 40 per node.
    return {"arithmetic": 2.0 * padded + 36 * lookups + 40 * visited, "fetches": fetches}


def open_browser(size: tuple[int, int]) -> Any:
    """Chromium with its driver."""
    import shutil

    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    found = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    if found is None or driver is None:
        print("no Chromium with chromedriver: nothing to measure")
        sys.exit(finish({}, {}, None))
    options.binary_location = found
    for flag in (*_FLAGS, f"--window-size={size[0] + 270},{size[1] + 140}"):
        options.add_argument(flag)
    started = webdriver.Chrome(options=options, service=Service(executable_path=driver))
    started.set_script_timeout(900)
    return started


_FRAMES = """
    const { viewer } = window.mbtf, { renderer } = viewer, [width, height, count] = arguments;
    viewer.draw = () => false;
    const mean = renderer.mean("test", width, height, 1), milliseconds = [];
    for (let k = 0; k <= count; k++) {
      const start = performance.now();
      renderer.frame(mean, [viewer.material], viewer.scene, height);
      milliseconds.push(performance.now() - start);
    }
    renderer._scene(viewer.material, mean.latest, viewer.scene, { shown: 3 }, [0, 0, width, height]);
    const nodes = mean.latest.read(0, 0, width, height);
    let sum = 0;
    for (let k = 0; k < nodes.length; k += 4) sum += nodes[k];
    const traced = viewer.content.materials[0].source.includes("TRACED");
    return [milliseconds.slice(1), traced ? sum / (width * height) : 0];
"""


def measure(driver: Any, folder: Path, size: tuple[int, int], frames: int) -> dict[str, Any]:
    """Figures of one material."""
    material = Material.load(folder)
    content, rounding = material_content(folder)
    html = write_page({"materials": [content]}, folder.name)
    with tempfile.TemporaryDirectory() as temporary:
        page = Path(temporary) / "viewer.html"
        page.write_text(html)
        start = time.perf_counter()
        driver.get(page.as_uri())
        while not driver.execute_script("return window.mbtf !== undefined"):
            time.sleep(0.02)
            if time.perf_counter() - start > 120:
                raise SystemExit(driver.execute_script("return document.body.innerText"))
        first = time.perf_counter() - start
        milliseconds, visited = driver.execute_script(_FRAMES, *size, frames)
    return {
        "material": folder.name,
        "texels": material.lattice.shape()[1],
        "megabytes": len(html.encode()) / 1e6,
        "rounding": rounding,
        "first_picture_s": first,
        "software_ms": float(np.median(milliseconds)),
        "visited_nodes": visited,
        **operations(material, visited),
    }


def describe(f: dict[str, Any], size: str) -> str:
    """Figures of one material as text."""
    return (
        f"{f['material']}, {f['texels']} texels: page {f['megabytes']:.2f} MB ({f['rounding']}), "
        f"first picture {f['first_picture_s']:.1f} s, {f['software_ms']:.0f} ms per frame "
        f"of {size} in software\n  per pixel {f['arithmetic']:.0f} operations, {f['fetches']:.0f} fetches, "
        f"{f['visited_nodes']:.1f} nodes; estimate {f['estimated_fps']:.0f} frames/s"
    )


def materials(given: list[Path]) -> Iterator[Path]:
    """The given ones, or random ones."""
    if given:
        yield from given
        return
    with tempfile.TemporaryDirectory() as temporary:
        for model, paper in (("relief", False), ("neumip", False), ("neumip", True)):
            yield random_material(Path(temporary), model, paper)


def main() -> int:
    """Measure, print, and compare with the thresholds."""
    parser = parser_of(__doc__)
    parser.add_argument("material", nargs="*", type=Path)
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--arithmetic", type=float, default=400.0, help="10^9 operations per second")
    parser.add_argument("--fetches", type=float, default=3.0, help="10^9 texel fetches per second")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    found, missed = [], []
    driver = open_browser((width, height))
    try:
        for folder in materials(options.material):
            figures = measure(driver, folder, (width, height), options.frames)
            pixels = width * height * 1e-9
            slowest = max(
                figures["arithmetic"] * pixels / options.arithmetic,
                figures["fetches"] * pixels / options.fetches,
            )
            figures["estimated_fps"] = 1.0 / slowest
            found.append(figures)
            print(describe(figures, options.size))
            missed += [
                f"{figures['material']}: {what}"
                for what, bad in (
                    ("size", figures["texels"] <= 256 and figures["megabytes"] > SIZE),
                    ("first picture", figures["first_picture_s"] > SECONDS),
                    ("frames per second", figures["estimated_fps"] < FRAMES_PER_SECOND),
                )
                if bad
            ]
    finally:
        driver.quit()
    thresholds = {"megabytes": SIZE, "first_picture_s": SECONDS, "estimated_fps": FRAMES_PER_SECOND}
    return finish({"materials": found, "missed": missed}, thresholds, not missed)


if __name__ == "__main__":
    start(main)
