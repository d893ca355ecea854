#!/bin/sh
# Installs everything into .venv: `make install`. Installs missing Debian packages with apt if that is allowed, else
# prints the command to run. Can be repeated; does nothing if everything is installed.
set -eu
cd "$(dirname "$0")/.."

compiler="gcc libc6-dev"
board="gcc-avr avr-libc arduino-core-avr libsimavr-dev libelf1"

# Each package is detected by one of its files, so that other ways of installing it count too.
missing=""
add() { missing="$missing $1"; }

python=""
for candidate in ${PYTHON:-} python3.11 python3 python3.12 python3.13; do
    if command -v "$candidate" >/dev/null 2>&1 &&
        "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        python=$candidate
        break
    fi
done
if [ -z "$python" ]; then
    echo "install: no Python 3.11 or newer found; run: sudo apt-get install python3.11 python3.11-venv" >&2
    exit 69
fi
if [ ! -x .venv/bin/python ]; then
    "$python" -c 'import ensurepip' 2>/dev/null || add "$("$python" -c 'import sys; print("python3.%d-venv" % sys.version_info[1])')"
fi
command -v cc >/dev/null 2>&1 && printf '#include <stdio.h>\n' | cc -E - >/dev/null 2>&1 || add "$compiler"
command -v avr-gcc >/dev/null 2>&1 && [ -e /usr/include/simavr/sim_avr.h ] &&
    [ -d /usr/share/arduino/hardware/arduino/avr/cores/arduino ] &&
    [ -d /usr/lib/avr/include ] || add "$board"

if [ -n "$missing" ]; then
    line="apt-get install -y --no-install-recommends$missing"
    as_root=""
    [ "$(id -u)" = 0 ] || as_root="sudo -n"
    if command -v apt-get >/dev/null 2>&1 && $as_root true 2>/dev/null; then
        echo "install: Debian packages:$missing"
        $as_root env DEBIAN_FRONTEND=noninteractive apt-get update -qq
        # shellcheck disable=SC2086 - a list of words
        $as_root env DEBIAN_FRONTEND=noninteractive $line -qq >/dev/null
    else
        echo "install: some Debian packages are missing and only an administrator may add them; run:" >&2
        echo "    sudo $line" >&2
        case $missing in
        *venv* | *libc6-dev*) exit 69 ;;
        esac
        echo "install: continuing without the emulated MEGA; the native board replaces it" >&2
    fi
fi

# Without it one test is skipped: the sketch compiled as the Arduino IDE does.
if ! command -v arduino-builder >/dev/null 2>&1 && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends -qq arduino-builder >/dev/null 2>&1 ||
        echo "install: arduino-builder is not available; the test of the sketch in the Arduino IDE will be skipped"
fi

here=$(pwd -P)
case $here in
*:*)
    echo "install: $here: Python's environments do not allow a colon in their path; move the checkout" >&2
    exit 69
    ;;
*[\$\`\"]*)
    echo "install: $here: .venv/bin/activate does not work in such a folder; call .venv/bin/modsoft-... instead" >&2
    ;;
esac
existing=""
[ ! -d .venv ] || existing=yes
[ -x .venv/bin/python ] || "$python" -m venv .venv
if [ -n "$existing" ] && [ "$(cat .venv/.installed 2>/dev/null)" != "$here" ]; then
    .venv/bin/python tools/move_environment.py .venv # the checkout was copied or moved
fi
echo "install: Python packages into .venv"
.venv/bin/python -m pip install --quiet --disable-pip-version-check --use-pep517 -c constraints.txt -e '.[dev]'
printf '%s\n' "$here" >.venv/.installed
echo "install: done"
