"""The one thing that pyproject.toml cannot say: how the fast plant (training/simulation/fleet.c) is compiled.

Optional: without a C compiler, or with one that has no vector extensions, everything else installs and PyElastica
serves. The vector width is chosen when it runs, so a wheel is for every processor of its architecture.
"""

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError


class BuildKernel(build_ext):
    """Leaves out at once what Microsoft's compiler cannot compile, instead of after a page of its errors."""

    def build_extension(self, extension):
        if self.compiler.compiler_type == "msvc":
            raise CompileError("the simulation kernel needs GCC or Clang; PyElastica is used instead")
        super().build_extension(extension)


setup(
    cmdclass={"build_ext": BuildKernel},
    ext_modules=[
        Extension(
            "modsoft.training.simulation._fleet",
            ["training/simulation/fleet.c"],
            depends=["training/simulation/fleet_kernel.h"],
            extra_compile_args=["-O3", "-fno-math-errno", "-ffp-contract=fast", "-Wno-psabi"],
            optional=True,
        )
    ],
)
