"""Updates the paths in a virtual environment that was copied or moved with its checkout:
`.venv/bin/python tools/move_environment.py .venv`. Afterwards pip has to install modsoft again."""

import re
import subprocess
import sys
from pathlib import Path

# The first lines of a script that pip installed: an interpreter, or where its path is long or has spaces, a shell.
HEAD = re.compile(rb"""\A(#!/bin/sh\n'''exec' "[^\n]*\n' '''\n|#![^\n]*python[^\n]*\n)""")


def head(python: Path) -> bytes:
    """First lines of a script, for any path: the shell runs the interpreter, Python reads them as a string."""
    quoted = re.sub(r'([$`"\\])', r"\\\1", str(python))
    return f"#!/bin/sh\n'''exec' \"{quoted}\" \"$0\" \"$@\"\n' '''\n".encode()


def main(environment: Path) -> None:
    python = environment.resolve() / "bin" / "python"
    base = getattr(sys, "_base_executable", sys.executable)
    subprocess.run([base, "-P", "-m", "venv", "--without-pip", str(environment)], check=True)  # activate, pyvenv.cfg
    for script in sorted((environment / "bin").iterdir()):
        if script.is_file() and not script.is_symlink():
            text = script.read_bytes()
            if HEAD.match(text):
                script.write_bytes(HEAD.sub(lambda _: head(python), text))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
