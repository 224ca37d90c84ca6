"""What the models cost to evaluate, and how many weights they have.

    python benchmarks/models.py [--levels 6] [--repeat 12]

Processor time of both stages per value, of models with random weights on a square tile: the least of some
repetitions, on one thread. ``hierarchical`` reads 81 places for every value.

The last line is one JSON object: figures, and the bars they are held to. Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

import numpy as np
import torch

from mbtf_fit.models import MODELS, build_model
from mbtf_gen.directions import from_projected_disk
from mbtf_gen.levels import Lattice

# Places that are read at a time.
PLACES = 1 << 15
# hierarchical costs at most so many times what neumip costs, both stages together.
BARS = {"hierarchical_over_neumip": 150.0}


def queries(n: int, finest: int) -> list[torch.Tensor]:
    """u, σ, light and view at random."""
    random = np.random.default_rng(0)
    sigma = 0.5 * np.exp2(-finest * random.random(n))
    light, view = (from_projected_disk(1.2 * random.random((n, 2)) - 0.6) for _ in range(2))
    return [torch.from_numpy(np.asarray(a, np.float32)) for a in (random.random((n, 2)), sigma, light, view)]


def measure(name: str, finest: int, repeat: int) -> dict[str, Any]:
    """Microseconds of processor time per value, and weights."""
    model = build_model(name, Lattice(finest))
    model.initialise(torch.Generator().manual_seed(0), 0.1)
    n = PLACES // model.positions
    u, sigma, light, view = queries(n, finest)
    first, second = [], []
    with torch.no_grad():
        for _ in range(repeat):
            start = time.process_time()
            features = model.stage1(u, sigma, view)
            middle = time.process_time()
            model.stage2(features, light, view)
            first.append(middle - start)
            second.append(time.process_time() - middle)
    return {
        "weights": sum(p.numel() for p in model.parameter_groups()[1]),
        "places": model.positions,
        "stage1_us": min(first) / n * 1e6,
        "stage2_us": min(second) / n * 1e6,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--levels", type=int, default=6)
    parser.add_argument("--repeat", type=int, default=12)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = {name: measure(name, arguments.levels, arguments.repeat) for name in MODELS}
    for name, f in found.items():
        print(
            f"{name:16s} {f['weights']:5d} weights   {f['places']:2d} places   "
            f"stage 1 {f['stage1_us']:8.2f} us   stage 2 {f['stage2_us']:8.2f} us"
        )
    total = {name: f["stage1_us"] + f["stage2_us"] for name, f in found.items()}
    ratio = total["hierarchical"] / total["neumip"]
    met = ratio <= BARS["hierarchical_over_neumip"]
    print(json.dumps({"figures": found, "hierarchical_over_neumip": ratio, "bars": BARS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
