"""Memory does not grow with the number of shards."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import RunPython

# Makes shards in one process and prints the resident memory after each, in kB.
CODE = """
import json, sys
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import generate
shards = int(sys.argv[2])
def resident():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmRSS"))
config = GeneratorConfig.model_validate({
    "material": sys.argv[1],
    "queries": {"train": str(shards * 512), "test": "512", "spp": 8, "test_spp": 8},
    "output": {"shard_queries": 512},
})
seen = []
generate(config, sys.argv[3], progress=lambda *_: seen.append(resident()))
print(json.dumps(seen))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no resident memory to read")
@pytest.mark.parametrize("shards", [60, pytest.param(200, marks=pytest.mark.slow)])
def test_memory_does_not_grow_with_the_number_of_shards(
    shards: int, tmp_path: Path, run_python: RunPython
) -> None:
    np.save(tmp_path / "height.npy", 0.1 * np.random.default_rng(0).random((16, 16)))
    done = run_python("-c", CODE, str(tmp_path / "height.npy"), str(shards), str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    resident = np.array(json.loads(done.stdout.splitlines()[-1]), np.float64)
    assert len(resident) >= shards
    # Pools fill and kernels are compiled in the first third; medians, so that no single shard decides.
    early, late = (np.median(part) for part in np.array_split(resident, 3)[1:])
    growth = (late - early) / (shards / 3)
    # A shard holds 33 kB of arrays, and its lanes take some hundreds in the kernel.
    assert growth < 8, f"{growth:.1f} kB per shard: {resident[:: max(1, shards // 20)]}"
