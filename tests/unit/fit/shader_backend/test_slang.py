"""The Slang module: values on Slang's CPU device, sampling, other languages, and what is refused."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from support.browser import SOFTWARE, browser
from support.material_cases import CASES, make
from support.slang_device import SlangDevice

from mbtf_core.app.console import run
from mbtf_core.directions import from_angles
from mbtf_fit.backends.shader.slang import SlangCompiler, module_of
from mbtf_fit.backends.shader.syntax import ENDINGS, PLAIN_TARGETS
from mbtf_fit.cli.app import app
from mbtf_fit.material.format import QUERY
from mbtf_fit.material.rounding import round_material
from mbtf_fit.ops import Network
from mbtf_fit.training.sampler import LightMixture, sampler_inputs

pytest.importorskip("slangpy", reason="no slangpy; to enable: pip install 'mbtf[shaders]'")
# Each takes seconds to compile: without those whose operations others have.
SHADED = sorted(CASES.keys() - {"black", "calibrated", "relief", "relief without hints"})


@pytest.mark.parametrize("case", SHADED)
def test_values_are_those_of_the_material(case: str, tmp_path: Path) -> None:
    material = make(case, tmp_path / "material")
    q = material.conformance
    found = SlangDevice(*module_of(material), tmp_path / "module").values(*(q[name] for name in QUERY))
    deviation = np.abs(found[:, :3] - q["rgb"]) / np.maximum(1.0, q["rgb"])
    assert q["rgb"].std() > 0.005
    # A traced ray may miss an edge.
    assert (deviation.max(1) > 1e-4).sum() <= 2
    through = np.zeros(len(found))
    if material.transmittance is not None:
        through = material.transmittance.evaluate(*(q[k] for k in ("u", "sigma", "omega_o")))
        assert through.std() > 0.1
    np.testing.assert_allclose(found[:, 3], through, atol=1e-4)


@pytest.mark.parametrize(
    ("case", "half", "cooperative"),
    [
        ("relief", True, False),
        ("relief", False, True),
        ("holes", True, True),
        ("direct offset, six outputs", True, True),
        ("four levels, softplus", False, True),
    ],
)
def test_half_precision(case: str, half: bool, cooperative: bool, tmp_path: Path) -> None:
    """A buffer of halves holds a rounded material exactly; cooperative vectors round all between layers."""
    material = make(case, tmp_path / "material")
    size = len(module_of(material)[1])
    if half:
        material, _ = round_material(material, "float16")
    module, content = module_of(material, half=half)
    assert (len(content) < 0.7 * size) == half
    # Networks that move lookups stay in single precision.
    layers = [n for n, t in material.model.weights().items() if n.endswith(".weight") and t.ndim == 2]
    cooperating = [name for name in layers if not name.startswith("offset_network")]
    assert len(re.findall(r"layer<\d+>\(", module)) == len(cooperating) > 0
    # HLSL's alignment of matrices.
    places = [int(n) for pair in re.findall(r"layer<\d+>\(\w+, (\d+), (\d+)\)", module) for n in pair]
    places += [int(n) for n in re.findall(r"#define MATRICES (\d+)", module)]
    assert len(places) > 4
    assert not any(place % 128 for place in places)
    q = material.conformance
    device = SlangDevice(module, content, tmp_path / "module", cooperative=cooperative)
    found = device.evaluate(*(q[name] for name in QUERY))
    apart = np.abs(found - q["rgb"]) / np.maximum(q["rgb"], q["rgb"].mean())
    assert (apart.max(1) > (2e-2 if cooperative else 1e-4)).sum() <= 2
    assert (np.median(apart) > 1e-5) == cooperative


RAISING = """
[shader("compute")] [numthreads(64, 1, 1)]
void raise_directions(uint3 thread : SV_DispatchThreadID) {
  if (thread.x >= query_count) return;
  uint k = 3 * thread.x;
  values[thread.x] = float4(raised(float3(queries[k], queries[k + 1], queries[k + 2])), MIN_COS);
}
"""


def test_directions_below_the_plane_and_the_data(tmp_path: Path) -> None:
    """Lights and views below the plane give 0; directions below the smallest cosine are raised to it."""
    material = make("relief", tmp_path / "material")
    least = material.description["data"]["min_cos"] = 0.2
    module, content = module_of(material)
    device = SlangDevice(module + RAISING, content, tmp_path / "module")
    q, below = material.conformance, np.array([1, 1, -1], np.float32)
    for factors in ((below, 1), (1, below), (np.array([1, 1, 0], np.float32), 1)):
        omega_i, omega_o = q["omega_i"] * factors[0], q["omega_o"] * factors[1]
        assert (device.evaluate(q["u"], q["sigma"], omega_i, omega_o) == 0).all()
    directions = from_angles(np.array([90.0, 30.0, 10.0, 0.1, -30.0]), np.full(5, 30.0)).astype(np.float32)
    found = device.run("raise_directions", 5, {"queries": directions})
    expected = directions.copy()
    expected[2:4] = from_angles(np.degrees(np.arcsin(least)), 30.0)
    np.testing.assert_allclose(found[:, :3], expected, atol=1e-6)
    np.testing.assert_allclose(found[:, 3], least, rtol=1e-6)


SAMPLING = """
StructuredBuffer<float> random_numbers;
RWStructuredBuffer<float4> samples;
uniform float3 view;
[shader("compute")] [numthreads(64, 1, 1)]
void sample_lights(uint3 thread : SV_DispatchThreadID) {
  if (thread.x >= query_count) return;
  uint k = 3 * thread.x;
  LightSample s = sample_light(stage1(float2(0.3, 0.6), 0.1, view), view,
                               float3(random_numbers[k], random_numbers[k + 1], random_numbers[k + 2]));
  samples[thread.x] = float4(s.omega_i, s.pdf);
}
[shader("compute")] [numthreads(64, 1, 1)]
void densities(uint3 thread : SV_DispatchThreadID) {
  if (thread.x >= query_count) return;
  uint k = 3 * thread.x;
  float3 omega_i = float3(random_numbers[k], random_numbers[k + 1], random_numbers[k + 2]);
  samples[thread.x] = float4(pdf_light(stage1(float2(0.3, 0.6), 0.1, view), omega_i, view));
}
"""


def _cells(omega: np.ndarray) -> np.ndarray:
    """Cell of each direction among 8 × 8 of equal solid angle: z, azimuth."""
    azimuth = np.arctan2(omega[:, 1], omega[:, 0]) / (2 * np.pi) % 1
    row, column = ((8 * x).astype(int).clip(0, 7) for x in ((omega[:, 2] + 1) / 2, azimuth))
    return np.asarray(8 * row + column)


@pytest.mark.parametrize("case", ["relief", "svbrdf"])
def test_lights_are_sampled_by_their_density(case: str, tmp_path: Path) -> None:
    """The density integrates to 1, and is that of the samples by their counts in cells."""
    material = make(case, tmp_path / "material", sampled=True)
    module, content = module_of(material)
    device = SlangDevice(module + SAMPLING, content, tmp_path / "module")
    view = from_angles(50.0, 30.0).astype(np.float32)
    random, count = np.random.default_rng(0), 1 << 16

    def call(entry: str, numbers: np.ndarray) -> np.ndarray:
        inputs = {"view": view.tolist(), "random_numbers": numbers}
        return device.run(entry, count, inputs, output="samples").astype(np.float64)

    z = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    sphere = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], 1)
    density = call("densities", sphere)[:, 0]
    assert density.mean() * 4 * np.pi == pytest.approx(1, abs=0.02)
    found = call("sample_lights", random.random((count, 3)))
    omega, pdf = found[:, :3], found[:, 3]
    np.testing.assert_allclose(np.linalg.norm(omega, axis=1), 1, atol=1e-4)
    np.testing.assert_allclose(call("densities", omega)[:, 0], pdf, rtol=2e-2, atol=1e-3)
    above = omega[:, 2] > 0.05
    # Samples per cell. The density peaks against the view, where 1 / (view . h) is not resolved.
    expected_count = 4 * np.pi * np.bincount(_cells(sphere), density, 64)
    deviation = np.bincount(_cells(omega), minlength=64) - expected_count
    deviation /= np.sqrt(expected_count + (0.01 * expected_count) ** 2 + 25)
    deviation[_cells(-view[None])] = 0
    assert np.abs(deviation).max() < 4.5
    solid = (above / np.maximum(pdf, 1e-9)).mean()
    error = (above / np.maximum(pdf, 1e-9)).std() / np.sqrt(count)
    assert abs(solid - 2 * np.pi * 0.95) < 5 * error


DENSITIES = """
[shader("compute")] [numthreads(64, 1, 1)]
void densities(uint3 thread : SV_DispatchThreadID) {
  if (thread.x >= query_count) return;
  uint k = 9 * thread.x;
  float3 omega_i = float3(queries[k + 3], queries[k + 4], queries[k + 5]);
  float3 omega_o = float3(queries[k + 6], queries[k + 7], queries[k + 8]);
  Seen seen = stage1(float2(queries[k], queries[k + 1]), queries[k + 2], omega_o);
  values[thread.x] = float4(pdf_light(seen, omega_i, omega_o));
}
"""


@pytest.mark.parametrize("case", ["relief under a coat", "holes"])
def test_densities_are_those_of_training(case: str, tmp_path: Path) -> None:
    """The density of lights, of a random network at random places, is that by which it was trained."""
    material = make(case, tmp_path / "material", sampled=True)
    assert material.sampler is not None
    q, network = material.conformance, material.sampler.operations[-1]
    assert isinstance(network, Network)
    x = sampler_inputs(material.model, material.sampler.operations, q["u"], q["sigma"], q["omega_o"])
    weights, last = material.sampler.tensors, len(network.hidden)
    for n in range(last + 1):
        x = x @ weights[f"{network.weights}.{n}.weight"].T + weights[f"{network.weights}.{n}.bias"]
        x = x.relu() if n < last else x
    light, view = (torch.from_numpy(q[name])[:, None] for name in ("omega_i", "omega_o"))
    expected = LightMixture.of(x).density(light, view)[:, 0].numpy()
    module, content = module_of(material)
    device = SlangDevice(module + DENSITIES, content, tmp_path / "module")
    found = device.values(*(q[name] for name in QUERY), entry="densities")[:, 0]
    assert expected.std() > 0.05
    assert (np.abs(found - expected) > 1e-4 * np.maximum(expected, 1.0)).sum() <= 2


# SPIR-V's OpCapability of VK_NV_cooperative_vector.
COOPERATIVE_VECTOR = struct.pack("<II", 0x00020011, 5394)
MARKS = {
    ".hlsl": b"StructuredBuffer<float4",
    ".spv": struct.pack("<I", 0x07230203),
    ".comp": b"#version 450",
    ".wgsl": b"@compute",
    ".metal": b"[[kernel]]",
    ".cu": b"__global__",
}


COOPERATIVE = ["--texture-format", "float16", "--shader-networks", "cooperative"]


def _command(folder: Path, more: list[str]) -> list[str]:
    """What exports to Slang alone."""
    return ["export", str(folder / "material"), "--to", "slang", *more, "-o", str(folder / "out"), "-q"]


def _languages(more: list[str]) -> list[str]:
    targets = [target for target in ENDINGS if not more or target not in PLAIN_TARGETS]
    return [word for target in targets for word in ("--shader-target", target)]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """Folders of a material in all languages, without and with cooperative vectors."""
    out = {}
    with pytest.MonkeyPatch.context() as patch:
        # By the SPIRV-Tools of Slang.
        patch.setenv("SLANG_RUN_SPIRV_VALIDATION", "1")
        for more in ([], COOPERATIVE):
            folder = out[bool(more)] = tmp_path_factory.mktemp("languages")
            make("relief", folder / "material")
            assert run(app, [*_command(folder, more), *_languages(more)]) == 0
    return out


@pytest.mark.parametrize("more", [[], COOPERATIVE])
def test_other_languages(more: list[str], exported: dict[bool, Path]) -> None:
    words, out = _languages(more), exported[bool(more)] / "out"
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert len(before) == 3 + len(words) / 2
    marks = MARKS | ({".hlsl": b"linalg_MulAdd", ".spv": COOPERATIVE_VECTOR} if more else {})
    assert (b"#define HALF_TEXELS" in before["material.slang"]) == bool(more)
    for name, text in before.items():
        assert marks.get(Path(name).suffix, b"") in text, name
    if not more:
        assert run(app, [*_command(exported[False], more), *words]) == 0
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_what_has_no_cooperative_vectors_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make("relief", tmp_path / "material")
    command = _command(tmp_path, COOPERATIVE)
    assert run(app, [*command, "--shader-target", "metal"]) == 2
    assert "Slang has no cooperative vectors for metal" in capsys.readouterr().err
    assert run(app, command) == 2
    assert "add --shader-target" in capsys.readouterr().err


COMPILERS = {
    ".cpp": "g++ -fsyntax-only -w",
    ".cu": "nvcc -ptx -w",
    ".comp": "glslangValidator -V",
    ".hlsl": "glslangValidator -D -V -S comp -e evaluate_queries",
}


@pytest.mark.parametrize("cooperative", [False, True])
@pytest.mark.parametrize("ending", COMPILERS)
def test_compilers_accept_them(
    ending: str, cooperative: bool, exported: dict[bool, Path], tmp_path: Path
) -> None:
    compiler, *flags = COMPILERS[ending].split()
    if shutil.which(compiler) is None:
        pytest.skip(
            f"no {compiler}; to enable on Debian: apt-get install g++ glslang-tools nvidia-cuda-toolkit"
        )
    if ending == ".hlsl" and cooperative:
        pytest.skip("glslang knows no cooperative vectors of HLSL")
    file = exported[cooperative] / f"out/material{ending}"
    subprocess.run([compiler, *flags, "-o", str(tmp_path / "compiled"), str(file)], check=True)


WEBGPU = """
const [code, done] = arguments;
(async () => {
  const device = await (await navigator.gpu.requestAdapter()).requestDevice();
  const { messages } = await device.createShaderModule({ code }).getCompilationInfo();
  done(messages.map((m) => `${m.type} in line ${m.lineNum}: ${m.message}`));
})().catch((error) => done([String(error)]));
"""


def test_browsers_accept_wgsl(exported: dict[bool, Path], tmp_path: Path) -> None:
    flags = ("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan")
    # WebGPU needs a secure context, which files are.
    (tmp_path / "page.html").write_text("<!doctype html>")
    code = (exported[False] / "out/material.wgsl").read_text()
    with browser(tmp_path / "profile", (*SOFTWARE, *flags)) as driver:
        driver.get((tmp_path / "page.html").as_uri())
        assert driver.execute_async_script(WEBGPU, code) == []
        (message,) = driver.execute_async_script(WEBGPU, code + "fn")
        assert message.startswith("error in line")


def test_the_documented_function_compiles(tmp_path: Path) -> None:
    make("relief", tmp_path / "material")
    out = tmp_path / "out"
    assert run(app, ["export", str(tmp_path / "material"), "--to", "slang", "-o", str(out), "-q"]) == 0
    page = Path(__file__).parents[4] / "docs/how-to/export-a-material.md"
    function = page.read_text().split("```\nimport material;")[1].split("```")[0]
    entry = """
RWStructuredBuffer<float3> shaded;
[shader("compute")] [numthreads(64, 1, 1)]
void shade_all(uint3 thread : SV_DispatchThreadID) {
  float2 uv = float2(thread.xy) / 64.0;
  shaded[thread.x] = shade(uv, 0.01, 0.02, normalize(float3(1.0)), float3(0.0, 0.0, 1.0), float3(1.0));
}
"""
    (out / "page.slang").write_text(f"import material;{function}{entry}")
    assert b"void shade_all(" in SlangCompiler().compile(out / "page.slang", "shade_all", "hlsl")
