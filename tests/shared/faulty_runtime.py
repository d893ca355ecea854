"""modsoft-runtime with faults at hand: SIGUSR1 raises an exception that nobody foresaw wherever the control thread
is, SIGUSR2 halts that thread for five seconds while all others go on."""

import signal
import time

from modsoft.runtime.cli import main


class Unforeseen(Exception):
    """A bug."""


def fail(number, frame):
    raise Unforeseen("a bug, injected")


if __name__ == "__main__":
    signal.signal(signal.SIGUSR1, fail)
    signal.signal(signal.SIGUSR2, lambda number, frame: time.sleep(5.0))
    main()
