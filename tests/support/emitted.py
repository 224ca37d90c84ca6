"""A recipe whose jobs are emitted, with names that shells and make read as something else."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mbtf_pipeline.emit.jobs import Target, emit_jobs
from mbtf_pipeline.emit.kubernetes import Cluster
from mbtf_pipeline.emit.steps import Request
from mbtf_pipeline.recipe import Recipe
from support.fake_cluster import PROGRAMS, calls, clean_environment

TARGETS: tuple[Target, ...] = ("slurm", "k8s", "make")
RECIPE = """
name: Two_fits
generate:
  material: "the maps/it's $HOME #1.npy"
  queries: {train: 64/texel, test: "100", resolution: 8}
  output: {shard_queries: 1024}
fit:
  neumip+: {training: {steps: 3}}
  images: {model: hierarchical, training: {steps: 3}}
"""
REQUEST = Request(seconds=3600.0)
SLICES = [f"shards {i}/3" for i in (1, 2, 3)]
IMAGES = [f"shards-image {i}/3" for i in (1, 2, 3)]
ALL = {
    *SLICES,
    *IMAGES,
    "mbtf-gen shards",
    "mbtf-gen shards-image",
    "mbtf-fit neumip+",
    "mbtf-fit images",
    "mbtf-pipeline the $$run",
}


def make_place(folder: Path) -> Path:
    """A folder with the recipe and its material."""
    place = folder / "a $b's #1"
    (place / "the maps").mkdir(parents=True)
    np.save(place / "the maps" / "it's $HOME #1.npy", np.random.default_rng(0).random((8, 8)))
    (place / "recipe.yaml").write_text(RECIPE)
    return place


def install_programs(folder: Path) -> dict[str, str]:
    """Make the programs' commands in a folder; returns the environment that finds them."""
    folder.mkdir()
    for name in PROGRAMS:
        command = shlex.join([sys.executable, "-m", name.replace("-", "_")])
        (folder / name).write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        (folder / name).chmod(0o755)
    return clean_environment(folder)


def start(line: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run the command that starts emitted jobs."""
    if line.startswith("make") and shutil.which("make") is None:
        pytest.skip("no make")
    return subprocess.run(
        ["bash", "-c", line], env=environment, capture_output=True, text=True, timeout=300, check=False
    )


def emitted(recipe: Recipe, target: Target, jobs: Path = Path("my jobs")) -> str:
    """Emit jobs of three slices for one target; returns the command that starts them."""
    cluster = Cluster("registry/mbtf:1")
    run_folder = Path("out/the $$run")
    done = emit_jobs(recipe, jobs, [target], run=run_folder, slices=3, request=REQUEST, cluster=cluster)
    return done.start[target]


def kinds(bin_folder: Path) -> list[str]:
    """What the programs were called for, in order."""
    out = []
    for call in calls(bin_folder):
        words = call["words"]
        if "--slice" in words:
            out.append(f"{Path(words[4]).name} {words[-1]}")
        else:
            out.append(f"{words[0]} {Path(words[-1]).name}")
    return out
