"""The runtime's `Board` on an emulated MEGA in mid-run, for faults of board, cable and bootloader.

`python mega_in_run.py PORT...` drives the boards at these ports until it is killed; it prints a line when all of them
are at `Host.BAR`.
"""

import contextlib
import random
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.board.stepped_port import SteppedPort
from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.ports import open_port
from modsoft.runtime.board.protocol import State

CHECK_S = 0.005  # as the control loop between two ticks


class Host:
    """Keeps six chambers at `BAR`, with a set-point every `PERIOD_S`.

    threaded: False leaves the port to the caller's thread.
    """

    BAR = 0.35  # the limit of the shipped robot: the longest ramp
    PERIOD_S = 0.4
    ROBOT = robot_file.load("pneumatic-3")

    def __init__(self, port, threaded=True, clock=time.monotonic):
        self.port, self.threaded, self.clock = port, threaded, clock
        self.board = Board(port, "the emulated MEGA", clock, threaded)
        self.tick = 0
        self.due_s = clock()

    def start(self):
        """Arms and runs until the board reports `BAR` for every chamber."""
        self.board.arm(self.ROBOT)
        self.run_for(3 * self.PERIOD_S)
        assert self.board.status.state == State.RUNNING
        assert min(self.board.applied_bar[:6]) == self.BAR

    def run_for(self, seconds):
        """Runs the control loop for this time; raises the errors of `Board.check`."""
        until_s = self.clock() + seconds
        while (now_s := self.clock()) < until_s:
            self.board.check()
            if now_s >= self.due_s:
                self.tick += 1
                self.due_s = now_s + self.PERIOD_S
                self.board.set_pressures(self.tick, np.full(6, self.BAR))
            if self.threaded:
                time.sleep(max(0.0, min(self.due_s, until_s, now_s + CHECK_S) - now_s))
            else:
                self.board._io_thread.pump()


@contextlib.contextmanager
def in_run(threaded=True):
    """(host, emulated board) in mid-run in real time, at a random phase of the period."""
    with EmulatedBoard("simavr") as emulated:
        emulated.send("sensors 20")
        host = Host(open_port(emulated.port, Host.ROBOT.serial.baud), threaded)
        try:
            host.start()
            host.run_for(random.uniform(0.0, Host.PERIOD_S))
            yield host, emulated
        finally:
            host.board._io_thread.close()


@contextlib.contextmanager
def in_stepped_run():
    """(host, emulated board) in mid-run, at a random phase of the period, both on the board's own clock."""
    with EmulatedBoard("simavr", stepped=True) as emulated:
        emulated.send("sensors 20")
        host = stepped_host(emulated)
        try:
            host.start()
            host.run_for(random.uniform(0.0, Host.PERIOD_S))
            host.port.idle(random.uniform(1e-6, 2e-3))  # at a random phase of the firmware's loop
            yield host, emulated
        finally:
            host.port.close()


def stepped_host(emulated, name=""):
    """A host on the clock of a stepped board, connected; `name`: of its port where that is not its first one."""
    port = SteppedPort(emulated, name)
    return Host(port, threaded=False, clock=port.clock)


def inject(emulated, command, name="command"):
    """Sends the board a command; returns its event `name` and the length of the trace before it."""
    since = len(emulated.trace)
    emulated.send(command)
    return emulated.wait_for(lambda event: event["event"] == name, 5.0, since), since


def side_by_side(tries, attempt, at_once=5):
    """Results of `attempt(number)` for every number below `tries`, `at_once` in parallel: a board is mostly idle."""
    with ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(attempt, range(tries)))


def main(names):
    """Drives the boards at these ports until the process ends."""
    hosts = side_by_side(len(names), lambda number: Host(open_port(names[number], 250_000)), len(names))
    side_by_side(len(hosts), lambda number: hosts[number].start(), len(hosts))
    print("in run", flush=True)
    side_by_side(len(hosts), lambda number: hosts[number].run_for(3600.0), len(hosts))


if __name__ == "__main__":
    main(sys.argv[1:])
