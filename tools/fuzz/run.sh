#!/bin/sh
# Coverage-guided fuzzing of the firmware's parser and supervisor: `make fuzz`, or tools/fuzz/run.sh [SECONDS].
# Starts from the corpus in this folder; new inputs go to build/fuzz/corpus, findings to build/fuzz.
set -eu
cd "$(dirname "$0")/../.."
seconds=${1:-60}

# Not in tools/install.sh: the compiler is large and has no other use.
if ! command -v clang >/dev/null 2>&1; then
    set -- clang
else
    version=$(clang -dumpversion)
    library=$(clang -print-file-name=libclang_rt.fuzzer-"$(uname -m)".a)
    [ -e "$library" ] && set -- || set -- "libclang-rt-${version%%.*}-dev"
fi
if [ $# -gt 0 ]; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
        echo "fuzz: Debian packages: $*"
        apt-get update -qq
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
        case $1 in
        clang) exec tools/fuzz/run.sh "$seconds" ;; # now the version of the library is known
        esac
    else
        echo "fuzz: a Debian package is missing; run: sudo apt-get install $*" >&2
        exit 69
    fi
fi

mkdir -p build/fuzz/corpus
make -s -C firmware fuzz
exec build/firmware/fuzz -max_total_time="$seconds" -max_len=512 -timeout=10 -print_final_stats=1 \
    -artifact_prefix=build/fuzz/ build/fuzz/corpus tools/fuzz/corpus
