"""How the kernel of the simulated robots (training/simulation/fleet.c) is compiled; all else is in pyproject.toml.

The kernel is optional: without a C compiler, or with one that has no vector extensions, PyElastica is used instead. The
vector width is chosen at run time, so a wheel runs on every processor of its architecture.
"""

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError


class BuildKernel(build_ext):
    """Does not try Microsoft's compiler, which cannot compile the kernel and would print a page of errors."""

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
