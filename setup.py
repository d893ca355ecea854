"""The one thing that pyproject.toml cannot say: how the fast plant (training/fleet.c) is compiled.

Optional: without a C compiler, or with one that has no vector extensions, everything else installs and PyElastica
serves. The vector width is chosen when it runs, so a wheel is for every processor of its architecture.
"""

from setuptools import Extension, setup

setup(
    ext_modules=[
        Extension(
            "modsoft.training._fleet",
            ["training/fleet.c"],
            depends=["training/fleet_kernel.h"],
            extra_compile_args=["-O3", "-fno-math-errno", "-ffp-contract=fast", "-Wno-psabi"],
            optional=True,
        )
    ]
)
