# For users: make demo, make install, make test. For developers: make check.

# torch with two threads on two busy cores can be ten times slower than with one.
export OMP_NUM_THREADS ?= 1
export OMP_WAIT_POLICY ?= PASSIVE
# Plots need no display.
export MPLBACKEND ?= Agg

PYTEST := .venv/bin/python -m pytest
# Holds the path of the checkout. In a copied or moved checkout .venv still refers to the original.
INSTALLED := .venv/.installed
MOVED := $(shell [ ! -e $(INSTALLED) ] || [ "$$(cat $(INSTALLED))" = "$$(pwd -P)" ] || echo moved)

.PHONY: demo install test test-python dist test-cluster reliability soak check coverage mutation fuzz firmware clean moved

demo: $(INSTALLED)
	.venv/bin/python tools/demo.py

install:
	tools/install.sh

$(INSTALLED): pyproject.toml setup.py constraints.txt tools/install.sh training/simulation/fleet.c training/simulation/fleet_kernel.h $(MOVED)
	tools/install.sh

test: $(INSTALLED)
	tools/test.sh

# The tests of runtime and export on every Python from 3.11 to 3.13 that is found.
test-python: $(INSTALLED)
	tools/test_pythons.sh

# Wheel and source distribution into dist/, each installed and run, with and without a C compiler.
dist: $(INSTALLED)
	.venv/bin/python tools/dist.py

# Collection through a real one-node SLURM, which the test installs and starts. Needs root on Debian.
test-cluster: $(INSTALLED)
	$(PYTEST) -m cluster

# Runs the failure matrix, one test per row, and writes docs/reliability.md.
reliability: $(INSTALLED)
	.venv/bin/python tools/reliability.py

# An hour of the rig with a fault about once a minute, then the failure matrix with its full numbers.
soak: $(INSTALLED)
	.venv/bin/python tools/soak.py --report docs/soak.md --full-matrix

check: $(INSTALLED)
	tools/check.sh

# Coverage of the safety part: of the firmware by its native tests, of the runtime's files in pyproject.toml by their
# unit tests. Fails below 100 % of lines and branches.
SAFETY_PARTS := connection controller loop safety stop
coverage: $(INSTALLED)
	.venv/bin/python tools/measure_coverage.py
	.venv/bin/python -m coverage run -m pytest -q $(foreach part,$(SAFETY_PARTS),$(wildcard tests/runtime/test_$(part)*.py))
	.venv/bin/python -m coverage report

# Mutation testing of the same files: their tests must detect every small wrong change.
mutation: $(INSTALLED)
	.venv/bin/python tools/mutate.py
	.venv/bin/python tools/mutate_runtime.py

# Coverage-guided fuzzing of the firmware for FUZZ_SECONDS. Needs clang: installs it as root, else prints the command.
FUZZ_SECONDS ?= 60
fuzz:
	tools/fuzz/run.sh $(FUZZ_SECONDS)

firmware:
	$(MAKE) -C firmware

clean:
	rm -rf build demo dist *.egg-info
