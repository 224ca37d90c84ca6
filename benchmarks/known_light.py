"""What `cloth` would leave if it knew the direct light of each query: which hints are worth improving.

    python benchmarks/known_light.py --out FOLDER [CLOTH ...] [--steps 400] [--paths 32]

At 64 texels, 200 queries per texel of 4 paths. Hints of the known surface are replaced, for training and
test queries, by what the generator traces along so many paths through each footprint: the ``visibility`` of
the light, direct light without shadows (``reflection``), or ``direct`` light. With the last, interreflection
remains, noise of the hints, and what the network does not learn in these steps. FOLDER keeps data and
figures, so the same command resumes. The last line is one JSON object.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from common import CLOTHS, finish, kept, parser_of, start
from quality import generator_config

from mbtf_core.data.schema import Queries
from mbtf_fit import FitConfig, fit
from mbtf_fit.pytorch import material
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.generation.run import generate
from mbtf_gen.planning.job import Job

KNOWN = ("nothing", "visibility", "reflection", "direct")
QUERIES = {"train": "200/texel", "test": "32768", "spp": 4, "test_spp": 32, "test_highlights": 0.75}
# Columns of the hints: irradiance and core, which visibility scales, and core.
SCALED, CORE = [1, 4, 5, 6], slice(4, 7)
RESOLUTION, LEAST = 64, 1e-3


class TracedHints:
    """In place of `compute_hints`: replaces what is to be known by what is traced through the fibers."""

    def __init__(self, job: Job, known: str, paths: int) -> None:
        load_mitsuba()
        from mbtf_gen.render.estimator import Estimator
        from mbtf_gen.render.path_tracer import Transport
        from mbtf_gen.render.scene import build_scene
        from mbtf_gen.sampling.light_kernel import LightKernel

        tile, light = build_scene(job.material, job.material.surface()), LightKernel(job.config.light.width)
        self.estimators = {
            known: Estimator(tile, light, Transport(interreflection=False, bsdf_sampling=False, shadowing=on))
            for known, on in (("reflection", False), ("direct", True))
        }
        self.known, self.paths, self.calls, self.hints = known, paths, 0, material.compute_hints

    def __call__(self, surface: Any, trace: Any, shade: Any, fibers: Any, *queries: torch.Tensor) -> Any:
        hints = self.hints(surface, trace, shade, fibers, *queries)
        self.calls += 1
        if self.known == "visibility":
            u, sigma, omega_i, omega_o = queries
            level = (-torch.log2(2.0 * sigma)).clamp(0.0, float(surface.lattice.finest))
            _, hit, depth = surface.intersections(trace, u, level, omega_o)
            assumed = surface.visibility(shade, hit, depth, level, omega_i).clamp_min(LEAST)
            direct, reflection = (self._traced(known, queries).sum(1) for known in ("direct", "reflection"))
            hints[:, SCALED] *= (direct / reflection.clamp_min(LEAST))[:, None] / assumed
        elif self.known != "nothing":
            hints[:, CORE] = self._traced(self.known, queries)
        return hints

    def _traced(self, known: str, queries: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """Means (n, 3) of paths through the footprints; those of one call have equal random numbers."""
        from mbtf_gen.render.estimates import Stream

        asked, stream = Queries(*(q.numpy() for q in queries)), Stream(7, "train", self.calls)
        found = self.estimators[known].estimate(asked, self.paths, stream)
        return torch.from_numpy(0.5 * (found.value_a + found.value_b))


def measure(name: str, folder: Path, steps: int, paths: int, known: str) -> dict[str, Any]:
    """Unexplained variance of a fit that knows so much."""
    config = generator_config(name, "draft", RESOLUTION, **QUERIES)
    generate(config, folder / "shards")
    training = {"steps": steps, "batch": 16384, "importance_sampling": False}
    options = FitConfig.model_validate({"model": "cloth", "device": "cpu", "training": training})
    with patch.object(material, "compute_hints", TracedHints(Job.load(config), known, paths)):
        result = fit(options, folder / "shards", folder / "fit", overwrite=True)
    return dict(result.errors["test"]["unexplained"])


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("materials", nargs="*", metavar="CLOTH")
    parser.add_argument("--out", type=Path, required=True, help="folder of data and figures")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--paths", type=int, default=32, help="paths of each hint, an even number")
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    for name in options.materials or CLOTHS:
        folder, sizes = options.out / name, (options.steps, options.paths)
        figures[name] = {
            known: kept(folder / f"{known}-{sizes}.json", partial(measure, name, folder, *sizes, known))
            for known in KNOWN
        }
        errors = (f"{e['value']:.3f} ± {e['error']:.3f}" for e in figures[name].values())
        print(f"| `{name}` | {' | '.join(errors)} |", flush=True)
    return finish(figures, {}, None)


if __name__ == "__main__":
    start(main)
