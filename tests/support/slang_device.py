"""Slang modules of materials on Slang's devices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mbtf_fit.backends.shader.slang import ENTRY


class SlangDevice:
    """A device with a module and its buffer.

    Parameters
    ----------
    module, content : of :func:`mbtf_fit.backends.shader.slang.module_of`
    folder : to write the module to
    cooperative : whether networks are cooperative vectors
    kind : ``cpu``, ``cuda``, ``vulkan``, …
    """

    def __init__(
        self, module: str, content: bytes, folder: Path, *, cooperative: bool = False, kind: str = "cpu"
    ) -> None:
        import slangpy as spy

        folder.mkdir(parents=True, exist_ok=True)
        (folder / "material.slang").write_text(module)
        defines = {"COOPERATIVE": "1"} if cooperative else {}
        options = {"include_paths": [str(folder)], "defines": defines}
        self._device = spy.Device(type=getattr(spy.DeviceType, kind), compiler_options=options)
        self._usage = spy.BufferUsage.shader_resource | spy.BufferUsage.unordered_access
        self._kernels: dict[str, Any] = {}
        bound = self._buffer(bytearray(content), 8 if "#define HALF_TEXELS" in module else 16)
        self._bound = {"material_texels": bound} | ({"material_weights": bound} if cooperative else {})

    def _buffer(self, content: bytearray, stride: int) -> Any:
        data = np.frombuffer(content, np.uint8)
        return self._device.create_buffer(size=len(data), struct_size=stride, usage=self._usage, data=data)

    def run(
        self, entry: str, count: int, inputs: dict[str, Any], width: int = 4, output: str = "values"
    ) -> np.ndarray:
        """What an entry writes (count, width); of inputs, arrays are buffers."""
        if entry not in self._kernels:
            program = self._device.load_program("material.slang", [entry])
            self._kernels[entry] = self._device.create_compute_kernel(program)
        given = {
            name: self._buffer(bytearray(value.astype(np.float32).tobytes()), 4)
            if isinstance(value, np.ndarray)
            else value
            for name, value in inputs.items()
        }
        out = self._buffer(bytearray(4 * count * width), 4 * width)
        given |= {**self._bound, "query_count": count, output: out}
        self._kernels[entry].dispatch(thread_count=[count, 1, 1], vars=given)
        return np.asarray(out.to_numpy().view(np.float32).reshape(count, width))

    def values(self, *queries: np.ndarray, entry: str = ENTRY) -> np.ndarray:
        """Values and transmittance (n, 4) of u, sigma, omega_i, omega_o; or what another entry writes."""
        u, sigma, omega_i, omega_o = queries
        numbers = np.concatenate([u, sigma[:, None], omega_i, omega_o], 1)
        return self.run(entry, len(u), {"queries": numbers})

    def evaluate(self, *queries: np.ndarray) -> np.ndarray:
        """Values (n, 3)."""
        return self.values(*queries)[:, :3]
