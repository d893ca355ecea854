"""modsoft-runtime with faults: SIGUSR1 raises an unexpected exception in the control thread, SIGUSR2 halts that thread
for five seconds while all others run."""

import signal
import time

from modsoft.runtime.cli import main


class UnexpectedError(Exception):
    """A bug."""


def fail(number, frame):
    raise UnexpectedError("a bug, injected")


if __name__ == "__main__":
    signal.signal(signal.SIGUSR1, fail)
    signal.signal(signal.SIGUSR2, lambda number, frame: time.sleep(5.0))
    main()
