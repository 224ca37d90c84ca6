"""What the models cost to evaluate, and how many weights they have.

    python benchmarks/models.py [--resolution 64] [--repeat 12]

Processor time of both stages per value, of models with random weights on a square tile: the least of some
repetitions, on one thread. ``hierarchical`` reads 81 places for every value; ``neumip-wide`` is the
``neumip`` that ``rock_cliff_128.py`` trains with more features and channels.

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
from rock_cliff_128 import MODELS as TRAINED

from mbtf_core.directions import from_projected_disk
from mbtf_core.lattice import Lattice
from mbtf_fit.config import build_model
from mbtf_fit.models.registry import MODELS

# Places that are read at a time.
PLACES = 1 << 15
# A model's name and the options of its network.
WIDE = "neumip-wide"
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in MODELS},
    WIDE: ("neumip", TRAINED[WIDE]["network"]),
}
# So many times what neumip costs, both stages together, is the most.
BARS = {"hierarchical": 150.0, WIDE: 2.0}


def queries(n: int, finest: int) -> list[torch.Tensor]:
    """u, σ, light and view at random."""
    random = np.random.default_rng(0)
    sigma = 0.5 * np.exp2(-finest * random.random(n))
    light, view = (from_projected_disk(1.2 * random.random((n, 2)) - 0.6) for _ in range(2))
    return [torch.from_numpy(np.asarray(a, np.float32)) for a in (random.random((n, 2)), sigma, light, view)]


def measure(name: str, finest: int, repeat: int) -> dict[str, Any]:
    """Microseconds of processor time per value, and weights."""
    model_name, network = CASES[name]
    model = build_model(model_name, Lattice(finest), **network)
    model.initialize(torch.Generator().manual_seed(0), 0.1)
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
    parser.add_argument("--resolution", type=int, default=64, help="texels across, a power of two")
    parser.add_argument("--repeat", type=int, default=12)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = {name: measure(name, arguments.resolution.bit_length() - 1, arguments.repeat) for name in CASES}
    for name, f in found.items():
        print(
            f"{name:16s} {f['weights']:5d} weights   {f['places']:2d} places   "
            f"stage 1 {f['stage1_us']:8.2f} us   stage 2 {f['stage2_us']:8.2f} us"
        )
    total = {name: f["stage1_us"] + f["stage2_us"] for name, f in found.items()}
    ratios = {name: total[name] / total["neumip"] for name in BARS}
    met = all(ratios[name] <= bar for name, bar in BARS.items())
    print(json.dumps({"figures": found, "over_neumip": ratios, "bars": BARS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
