"""A residual normal map adds the slopes that a coarse mesh lacks, and none twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.paths import ROOT

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.planning.bounds import Change
from mbtf_gen.planning.run_plan import reference_plan
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.heights import height_slopes
from mbtf_gen.tile.loading import load_material

SPP = 16


def lambert(material: HeightFieldTile) -> HeightFieldTile:
    return material.with_maps(roughness=None, metallic=None, specular=None, normal=None)


def normals_of(material: HeightFieldTile) -> np.ndarray[tuple[int, int, int], np.dtype[np.float32]]:
    """The normal map that the heights would have, at their own resolution."""
    slopes = height_slopes(material.at(mesh=material.height.shape[1]).grid)
    n = np.concatenate([-slopes, np.ones_like(slopes[..., :1])], axis=-1)
    return (n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)


def estimates(material: HeightFieldTile, mesh: int, normal: str) -> Estimates:
    config = GeneratorConfig.model_validate(
        {
            "material": "m",
            "geometry": {"mesh": mesh},
            # High directions: what is compared is shading, not the masking that a coarse mesh lacks.
            "queries": {"resolution": 32, "min_cos": 0.7},
            "effects": {"normal": normal},
            "transport": {"max_depth": 1},
        }
    )
    job = Job.of(config, material)
    plan = reference_plan(job)
    assert plan.on("normal") == (normal != "off")
    found: Estimates = build_estimator(job, plan).estimate(
        pilot_queries(job, 16384), SPP, Stream(2, "test", 0)
    )
    return found


@pytest.mark.parametrize("name", ["turtle_shell", "rock_cliff"])
def test_a_coarse_mesh_with_the_residual_comes_closer_to_the_fine_one(name: str) -> None:
    folder = ROOT / "assets" / name
    if not folder.exists():
        folder = ROOT.parent / "shared" / "data" / "materials" / name
    if not folder.exists():
        pytest.skip(f"{name} is not beside the project")
    plain = lambert(load_material(folder))
    # Reliefs gentle enough for slopes to stand for displacement.
    plain = replace(plain, height_scale=0.3 * plain.height_scale)
    fine = plain.height.shape[1]
    mapped = plain.with_maps(normal=normals_of(plain))
    full = estimates(mapped, fine, "off")
    without = Change.of(full, estimates(mapped, fine // 16, "off")).rms
    found = Change.of(full, estimates(mapped, fine // 16, "residual"))
    residual, upper = found.rms, found.upper
    assert residual < 0.8 * without
    assert upper - residual < 0.2 * without
    # On the fine mesh the map repeats everything: nothing changes, while the slopes twice would.
    found = Change.of(full, estimates(mapped, fine, "residual"))
    same, bound = found.rms, found.upper
    assert bound < 0.3 * without
    assert same < residual
