"""A material's networks for RTX Neural Shading (1.3 and later), a file each.

Its ``HostNetwork::InitialiseFromJson`` reads ``layers``, each of ``num_inputs``, ``num_outputs``, ``weights``
(row by row, a row per output) and ``biases``, and rounds them to half precision. It ignores other keys: here
they say what the network reads and computes. It takes 2 to 8 layers, and one width between the first and the
last, which zeros fill up here.
"""

from __future__ import annotations

import json
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import write_text
from mbtf_fit.export import Export, ExportTarget

NAMES = [f"network-{k}.json" for k in range(1, 9)]
FEWEST_LAYERS, MOST_LAYERS = 2, 8


def _layer(weight: NDArray[Any], bias: NDArray[Any], inputs: int, outputs: int) -> dict[str, Any]:
    """A layer of more inputs and outputs, of which zeros are the rest."""
    wide, biases = np.zeros((outputs, inputs), np.float16), np.zeros(outputs, np.float16)
    with np.errstate(over="ignore"):
        wide[: weight.shape[0], : weight.shape[1]] = weight
        biases[: len(bias)] = bias
    if not (np.isfinite(wide).all() and np.isfinite(biases).all()):
        raise InputError("a weight is beyond half precision (65504)", hint="leave this format out")
    numbers = {"weights": wide.ravel().tolist(), "biases": biases.tolist()}
    return {"num_inputs": inputs, "num_outputs": outputs, **numbers}


def write(export: Export, options: None) -> list[str]:
    """Write the networks of the material and of its sampler, in the order of their operations."""
    from mbtf_fit.ops import Network
    from mbtf_fit.ops.operation import input_sizes
    from mbtf_fit.ops.sampler import sampler_sizes

    operations, sampler = export.material.model.stored_operations(), export.material.sampler
    more = [] if sampler is None else sampler.operations
    tensors = export.material.model.weights() | ({} if sampler is None else sampler.tensors)
    sizes = sampler_sizes(operations, more)
    networks = [op for op in [*operations, *more] if isinstance(op, Network)]
    fitting = [op for op in networks if FEWEST_LAYERS <= len(op.hidden) + 1 <= MOST_LAYERS]
    if not 1 <= len(fitting) <= len(NAMES):
        what = f"{len(fitting)} networks of {FEWEST_LAYERS} to {MOST_LAYERS} layers"
        raise InputError(f"has {what}; this format takes 1 to {len(NAMES)}", where=export.source)
    left = ", ".join(f"'{op.weights}'" for op in networks if op not in fitting)
    if left:
        export.notes.append(f"left out, as a single layer or more than {MOST_LAYERS}: {left}")
    names = NAMES[: len(fitting)]
    for name, op in zip(names, fitting, strict=True):
        inputs = input_sizes(op, sizes)
        widths = [sum(inputs), *[max(op.hidden)] * len(op.hidden), op.outputs]
        layers = []
        for n, shape in enumerate(pairwise(widths)):
            weight, bias = (tensors[f"{op.weights}.{n}.{part}"].cpu().numpy() for part in ("weight", "bias"))
            layers.append(_layer(weight, bias, *shape))
        about = {
            "network": op.weights,
            "inputs": dict(zip(op.x, inputs, strict=True)),
            "output": op.output,
            "activation": op.activation,
        }
        write_text(export.folder / name, json.dumps(about | {"layers": layers}))
        export.notes.append(f"{name}: {op.weights}, {'-'.join(map(str, widths))}, {op.activation}")
    return names


TARGET = ExportTarget("rtxns", "the networks alone, in half precision, for RTX Neural Shading", NAMES, write)
