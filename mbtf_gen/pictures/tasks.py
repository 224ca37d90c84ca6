"""A reference picture as a task: its value is the picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.pictures import Camera, PixelKind, ReferenceImage
from mbtf_gen.job import Job
from mbtf_gen.pictures.reference import render_reference
from mbtf_gen.planning.effects_planner import reference_plan
from mbtf_gen.planning.simulation import build_estimator

_kept: tuple[Job, Any] | None = None


def picture_estimator(job: Job) -> Any:
    """The estimator of a job's pictures, kept for the next one."""
    global _kept
    if _kept is None or _kept[0] is not job:
        _kept = job, build_estimator(job, reference_plan(job))
    return _kept[1]


def render_picture(
    job: Job,
    camera: Camera,
    omega_i: NDArray[np.float64],
    *,
    kind: PixelKind,
    spp: int,
    seed: int,
    index: int,
) -> ReferenceImage:
    """Render one picture; a task.

    Parameters
    ----------
    job : Job
        Its material and options.
    camera, omega_i, kind, spp, seed, index
        As for :func:`~mbtf_gen.pictures.reference.render_reference`.

    Returns
    -------
    ReferenceImage
    """
    return render_reference(
        picture_estimator(job), camera, omega_i, kind=kind, spp=spp, seed=seed, index=index
    )
