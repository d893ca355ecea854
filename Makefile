# What a newcomer types: make demo, make install, make test. What a developer types: make check.

# torch with two threads on two busy cores can be ten times slower than with one.
export OMP_NUM_THREADS ?= 1
export OMP_WAIT_POLICY ?= PASSIVE
# The test matrices need no display.
export MPLBACKEND ?= Agg

PYTEST := .venv/bin/python -m pytest
# It holds the checkout's path: in one that was copied or moved, .venv refers to the original.
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

# Collection through a real one-node SLURM, which the test installs and starts: root on Debian.
test-cluster: $(INSTALLED)
	$(PYTEST) -m cluster

# The failure matrix, a test a row, to docs/reliability.md.
reliability: $(INSTALLED)
	.venv/bin/python tools/reliability.py

# An hour of the rig with a fault about once a minute, then the long proofs.
soak: $(INSTALLED)
	.venv/bin/python tools/soak.py --report docs/soak.md --proofs

check: $(INSTALLED)
	tools/check.sh

# The safety part: the firmware by its native tests, and the files of the runtime that pyproject.toml lists by their unit
# tests. Fails below 100 % of lines and branches.
SAFETY_PARTS := connection controller loop safety stop
coverage: $(INSTALLED)
	.venv/bin/python tools/coverage.py
	.venv/bin/python -m coverage run -m pytest -q $(foreach part,$(SAFETY_PARTS),$(wildcard tests/runtime/test_$(part)*.py))
	.venv/bin/python -m coverage report

# Small wrong changes of the same files, each of which their tests must detect.
mutation: $(INSTALLED)
	.venv/bin/python tools/mutate.py
	.venv/bin/python tools/mutate_runtime.py

# Coverage-guided fuzzing of the firmware for FUZZ_SECONDS; needs clang, which it installs or asks for.
FUZZ_SECONDS ?= 60
fuzz:
	tools/fuzz/run.sh $(FUZZ_SECONDS)

firmware:
	$(MAKE) -C firmware

clean:
	rm -rf build demo dist *.egg-info
