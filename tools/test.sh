#!/bin/sh
# Runs the whole suite in three parts: `make test`. Each part runs even if an earlier one failed.
set -u
cd "$(dirname "$0")/.."
failed=0
part() {
    what=$1
    shift
    echo "test: $what"
    .venv/bin/python -m pytest "$@" || failed=1
}

part "all but the tests against the wall clock" -n 2 --dist worksteal -m "not realtime and not cluster"

# Tests that compute with torch, its libraries or our kernel run again as on a processor without AVX-512 and AMX.
if grep -q avx512f /proc/cpuinfo 2>/dev/null; then
    (
        export ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2 MKL_ENABLE_INSTRUCTIONS=AVX2 MODSOFT_KERNEL=avx2
        part "vector instructions limited to AVX2" -n 2 --dist worksteal -m "instructions and not realtime"
        exit "$failed"
    ) || failed=1
else
    echo "test: this processor has no AVX-512, so the tests above ran with AVX2 or less"
fi

part "the tests against the wall clock, one at a time" -m realtime
exit "$failed"
