"""Compiles the fitter's kernel where there is a C compiler; everything else stands in pyproject.toml.

Without one the installation succeeds all the same, and fits run in PyTorch.
"""

from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

SOURCES = "mbtf_fit/native/src"


class BuildKernel(build_ext):
    """Builds a plain library that is called through ctypes: it exports no module function."""

    def get_export_symbols(self, ext):
        return ext.export_symbols

    def build_extension(self, ext):
        if self.compiler.compiler_type == "msvc":
            self.warn("the kernel needs GCC or Clang: fits will run in PyTorch")
            return
        super().build_extension(ext)


setup(
    ext_modules=[
        Extension(
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
        )
    ],
    cmdclass={"build_ext": BuildKernel},
)
