#!/bin/sh
# Style and types, for people and for the tests. Type checkers do not follow the package mapping of pyproject.toml, so
# they get links that look like it.
set -eu
cd "$(dirname "$0")/.."
bin=.venv/bin
mkdir -p build/types/modsoft
for part in runtime training export; do ln -sfn "../../../$part" "build/types/modsoft/$part"; done
for part in hil study; do ln -sfn "../../../tools/$part" "build/types/modsoft/$part"; done
"$bin/ruff" check .
"$bin/ruff" format --check --quiet .
find firmware tests tools training \( -name '*.[ch]' -o -name '*.ino' \) -exec \
    "$bin/python" -c 'import clang_format; clang_format.clang_format()' --dry-run -Werror {} +
"$bin/python" tools/gen_protocol.py --check
"$bin/python" tools/wiring.py --check
"$bin/python" tools/words.py
"$bin/mypy" -p modsoft.runtime -p modsoft.export -p modsoft.hil -p modsoft.training -p modsoft.study
