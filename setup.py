"""Compiles the fitter's kernel where there is a C compiler; everything else stands in pyproject.toml.

Without one the installation succeeds all the same, and fits run in PyTorch. With ``MBTF_KERNEL=off`` in the
environment nothing is compiled, and the wheel is one for any machine.
"""

import os
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError

SOURCES = "mbtf_fit/native/src"
WITHOUT = "the kernel is not built, and fits will run in PyTorch"


class BuildKernel(build_ext):
    """Builds a plain library that is called through ctypes: it exports no module function."""

    def get_export_symbols(self, ext):
        return ext.export_symbols

    def build_extension(self, ext):
        if self.compiler.compiler_type == "msvc":
            self.warn(f"{WITHOUT}: it needs GCC or Clang")
            return
        try:
            super().build_extension(ext)
        except (BaseError, CCompilerError) as error:
            self.warn(f"{WITHOUT}: {error}")


kernel = Extension(
    "mbtf_fit.native._kernel",
    [f"{SOURCES}/{name}.c" for name in ("kernel", "heightfield", "hints")],
    depends=sorted(str(path) for path in Path(SOURCES).glob("*.[hi]*")),
    extra_compile_args=[
        "-std=gnu11",
        "-O3",
        "-ffp-contract=fast",
        "-fno-math-errno",
        "-fno-trapping-math",
        "-fvisibility=hidden",
        "-Wno-psabi",
    ],
    libraries=["m"],
    optional=True,
    # It uses nothing of Python: one wheel is for all versions.
    py_limited_api=True,
)
setup(
    ext_modules=[] if os.environ.get("MBTF_KERNEL") == "off" else [kernel],
    cmdclass={"build_ext": BuildKernel},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
