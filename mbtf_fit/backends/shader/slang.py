"""Export of a material as a Slang module, with the buffer that it reads, and in other languages by Slang's
compiler, as the package ``slangpy`` brings it."""

from __future__ import annotations

import ctypes
import importlib.util
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from mbtf_core.errors import EngineError, reason
from mbtf_core.extras import extra_error
from mbtf_core.files.atomic import write_chunks, write_text
from mbtf_fit.backends.shader.images import buffer_of
from mbtf_fit.backends.shader.program import program_of
from mbtf_fit.backends.shader.syntax import ENDINGS, SLANG, Target, number
from mbtf_fit.material.format import DEFAULT_MIN_COS
from mbtf_fit.material.material import Material

MODULE_NAME, TEXELS_NAME = "material.slang", "material.bin"
ENTRY = "evaluate_queries"
# What CUDA's half precision needs of Slang's prelude.
CUDA_HALF = b"#define SLANG_CUDA_ENABLE_HALF 1\n"


def module_of(material: Material, *, half: bool = False) -> tuple[str, bytes]:
    """The module of a material, and its buffer; whether that is in half precision.

    Raises
    ------
    InputError : it has an operation that shaders do not have
    """
    program = program_of(material, SLANG, sampled=True)
    buffer = buffer_of(program.images, program.weights, program.matrices, half=half)
    least = material.description["data"].get("min_cos", DEFAULT_MIN_COS)
    own = [
        SLANG.prologue,
        f"#define WEIGHT(i) vector_at({buffer.weights} + (i))",
        f"CONSTANT float MIN_COS = {number(least)};",
        *(SLANG.image.format(name=i, place=p) for i, p in zip(program.images, buffer.places, strict=True)),
        program.code,
    ]
    head, tail = files(__package__).joinpath("module.slang").read_text().split("//MATERIAL\n")
    head = head.replace("//MODEL", f"// Model: {material.model.name}.")
    defined = ["#define HALF_TEXELS"] * half + [f"#define MATRICES {buffer.matrices}"]
    head = head.replace("//BUFFER", "\n".join(defined))
    return head + "\n".join([*own, tail]), buffer.content


def write_module(
    material: Material,
    folder: Path,
    targets: Sequence[Target] = (),
    *,
    half: bool = False,
    cooperative: bool = False,
) -> list[str]:
    """Write the module, its buffer, and the module in other languages; returns the names of the files.

    Parameters
    ----------
    targets : the other languages
    half : whether the buffer is in half precision
    cooperative : whether networks are cooperative vectors in the other languages

    Raises
    ------
    InputError : the material has an operation that shaders do not have
    EngineError : Slang's compiler is missing
    """
    compiler = SlangCompiler() if targets else None
    module, buffer = module_of(material, half=half)
    write_text(folder / MODULE_NAME, module)
    write_chunks(folder / TEXELS_NAME, [buffer])
    written = [MODULE_NAME, TEXELS_NAME]
    defined = ["-DCOOPERATIVE"] if cooperative else []
    for target in targets:
        assert compiler is not None
        name = Path(MODULE_NAME).with_suffix(ENDINGS[target]).name
        code = compiler.compile(folder / MODULE_NAME, ENTRY, target, defined)
        write_chunks(folder / name, [CUDA_HALF, code] if target == "cuda" else [code])
        written.append(name)
    return written


def _library() -> ctypes.CDLL:
    found = importlib.util.find_spec("slangpy")
    names = ("libslang-compiler.so*", "libslang-compiler*.dylib", "slang-compiler.dll", "slang.dll")
    if found is not None and found.origin is not None:
        folder = Path(found.origin).parent
        for name in names:
            for path in sorted(folder.glob(name)):
                return ctypes.CDLL(str(path))
    raise extra_error("slangpy", "--shader-target")


class SlangCompiler:
    """Compiles modules to other languages.

    Raises
    ------
    EngineError : the package slangpy is not installed
    """

    def __init__(self) -> None:
        self._lib = _library()
        for name in ("spCreateSession", "spCreateCompileRequest", "spGetCompileRequestCode"):
            getattr(self._lib, name).restype = ctypes.c_void_p
        self._lib.spGetDiagnosticOutput.restype = ctypes.c_char_p
        self._session = ctypes.c_void_p(self._lib.spCreateSession(None))

    def compile(self, module: Path, entry: str, target: Target, options: Sequence[str] = ()) -> bytes:
        """A compute shader in another language, with more options of the compiler.

        Raises
        ------
        EngineError : the compiler refuses the module
        """
        request = ctypes.c_void_p(self._lib.spCreateCompileRequest(self._session))
        try:
            words = [str(module), "-target", target, "-entry", entry, "-stage", "compute", *options]
            array = (ctypes.c_char_p * len(words))(*(word.encode() for word in words))
            status = self._lib.spProcessCommandLineArguments(request, array, len(words))
            code, size = None, ctypes.c_size_t()
            if status >= 0 and self._lib.spCompile(request) >= 0:
                code = self._lib.spGetCompileRequestCode(request, ctypes.byref(size))
            if not code:
                said = (self._lib.spGetDiagnosticOutput(request) or b"").decode(errors="replace")
                raise EngineError(f"Slang makes no {target} of it: {reason(said, 400)}", where=module)
            return ctypes.string_at(code, size.value)
        finally:
            self._lib.spDestroyCompileRequest(request)
