"""Reference pictures on the workers of a cluster: a task is a picture, which the worker returns."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.cluster.task import Task
from mbtf_core.pictures.camera import Camera, PixelKind
from mbtf_core.pictures.reference import ReferenceImage
from mbtf_gen.job import Job
from mbtf_gen.pictures.reference import render_reference
from mbtf_gen.planning.effects_planner import reference_plan
from mbtf_gen.planning.simulation import build_estimator


def picture_task(
    name: str,
    job: Job,
    camera: Camera,
    omega_i: NDArray[np.floating],
    *,
    kind: PixelKind,
    spp: int,
    seed: int,
    index: int,
) -> Task:
    """The task of one picture, whose value is that of
    :func:`~mbtf_gen.pictures.reference.render_reference` with these arguments."""
    picture = {"kind": kind, "spp": spp, "seed": seed, "index": index}
    arguments = {
        "config": json.dumps(job.portable()),
        "config_hash": job.config_hash,
        "camera": asdict(camera),
        "omega_i": [float(x) for x in omega_i],
        "picture": picture,
    }
    return Task(name, "mbtf_gen.pictures.distribute:render_picture", arguments)


def render_picture(
    config: str, config_hash: str, camera: dict[str, Any], omega_i: list[float], picture: dict[str, Any]
) -> ReferenceImage:
    """Render one picture; runs on a worker.

    Parameters
    ----------
    config : str
        :meth:`Job.portable <mbtf_gen.job.Job.portable>` as JSON.
    config_hash : str
        Its hash, contents of files included.
    camera, omega_i, picture
        Arguments of :func:`~mbtf_gen.pictures.reference.render_reference`.

    Returns
    -------
    ReferenceImage

    Raises
    ------
    InputError
        The material's files differ on this machine.
    """
    light = np.asarray(omega_i, np.float64)
    return render_reference(_estimator(config, config_hash), Camera(**camera), light, **picture)


@lru_cache(maxsize=1)
def _estimator(config: str, config_hash: str) -> Any:
    """The estimator of a material, kept for its next picture."""
    job = Job.of_portable(config, config_hash)
    return build_estimator(job, reference_plan(job))
