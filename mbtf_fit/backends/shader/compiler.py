"""Slang's compiler, as the package ``slangpy`` brings it, by its C interface."""

from __future__ import annotations

import ctypes
import importlib.util
from pathlib import Path
from typing import Literal, get_args

from mbtf_core.errors import EngineError, reason

Target = Literal["hlsl", "glsl", "wgsl", "metal", "cuda", "cpp"]
ENDINGS: dict[Target, str] = {
    "hlsl": ".hlsl",
    "glsl": ".comp",
    "wgsl": ".wgsl",
    "metal": ".metal",
    "cuda": ".cu",
    "cpp": ".cpp",
}
TARGETS: tuple[Target, ...] = get_args(Target)
# Entries of an ISlangBlob's table of functions, after those of ISlangUnknown.
_POINTER, _SIZE = 3, 4


def _library() -> ctypes.CDLL:
    found = importlib.util.find_spec("slangpy")
    names = ("libslang-compiler.so*", "libslang-compiler*.dylib", "slang-compiler.dll", "slang.dll")
    if found is not None and found.origin is not None:
        folder = Path(found.origin).parent
        for name in names:
            for path in sorted(folder.glob(name)):
                return ctypes.CDLL(str(path))
    raise EngineError(
        "Slang's compiler is not installed",
        where="--shader-target",
        hint="pip install 'mbtf[shaders]' (290 MB)",
    )


class SlangCompiler:
    """Compiles modules to other languages.

    Raises
    ------
    EngineError
        The package slangpy is not installed.
    """

    def __init__(self) -> None:
        self._lib = _library()
        for name in ("spCreateSession", "spCreateCompileRequest", "spGetEntryPointCode"):
            getattr(self._lib, name).restype = ctypes.c_void_p
        self._lib.spGetDiagnosticOutput.restype = ctypes.c_char_p
        self._session = ctypes.c_void_p(self._lib.spCreateSession(None))

    def compile(self, module: Path, entry: str, target: Target) -> bytes:
        """Text of a compute shader in another language.

        Raises
        ------
        EngineError
            The compiler refuses the module.
        """
        request = ctypes.c_void_p(self._lib.spCreateCompileRequest(self._session))
        try:
            words = [str(module), "-target", target, "-entry", entry, "-stage", "compute"]
            array = (ctypes.c_char_p * len(words))(*(word.encode() for word in words))
            status = self._lib.spProcessCommandLineArguments(request, array, len(words))
            status = self._lib.spCompile(request) if status >= 0 else status
            code = self._code(request) if status >= 0 else b""
            if not code:
                said = (self._lib.spGetDiagnosticOutput(request) or b"").decode(errors="replace")
                raise EngineError(f"Slang makes no {target} of it: {reason(said, 400)}", where=module)
            return code
        finally:
            self._lib.spDestroyCompileRequest(request)

    def _code(self, request: ctypes.c_void_p) -> bytes:
        """Code of the entry point; of targets without entry points that of the whole module."""
        size = ctypes.c_size_t()
        pointer = self._lib.spGetEntryPointCode(request, 0, ctypes.byref(size))
        if pointer and size.value:
            return ctypes.string_at(pointer, size.value)
        blob = ctypes.c_void_p()
        if self._lib.spGetTargetCodeBlob(request, 0, ctypes.byref(blob)) < 0 or not blob.value:
            return b""
        return _bytes(blob.value)


def _bytes(blob: int) -> bytes:
    table = ctypes.cast(
        ctypes.cast(blob, ctypes.POINTER(ctypes.c_void_p))[0] or 0, ctypes.POINTER(ctypes.c_void_p)
    )
    pointer = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(table[_POINTER] or 0)
    size = ctypes.CFUNCTYPE(ctypes.c_size_t, ctypes.c_void_p)(table[_SIZE] or 0)
    return ctypes.string_at(pointer(blob) or 0, size(blob))
